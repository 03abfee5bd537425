"""Assignments `key=value` on a command line."""


def refuse_twice(given: dict[str, str], key: str, option: str) -> None:
    """Note in `given` the option that gives a key; "-" may stand for "_".

    Raises:
        ValueError: Another option also gives it: only the last would count.
    """
    field = key.strip().replace("-", "_")
    if field in given:
        message = f"{given[field]}, {option}: one setting is given twice: leave one of the two out"
        raise ValueError(message)
    given[field] = option
