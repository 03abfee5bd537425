"""What is wrong with a link, in one line: which setting, what was seen, what is allowed."""

import math
import re
from typing import Any

from msgspec import ValidationError


class LinkError(ValueError):
    """Settings that describe no link.

    Args:
        key: The setting, with its place in a list or table, as in `outages.0.times.period_s`.
        problem: What follows it: ` = seen: must be allowed`, or `: what is wrong`.
    """

    def __init__(self, key: str, problem: str) -> None:
        super().__init__(f"{key}{problem}")
        self.key = key
        """The setting."""
        self.problem = problem
        """The rest of the message."""


def wrong(key: str, seen: object, allowed: str) -> LinkError:
    """A value that is not allowed."""
    text = f'"{seen}"' if isinstance(seen, str) else f"{seen}"
    return LinkError(key, f" = {text if len(text) <= 80 else f'{text[:76]} ...'}: must be {allowed}")


_OF_RULES = re.compile(r"(?P<key>[\w.]+)(?P<problem>(?: = |: ).*)", re.DOTALL)


def of_rules(error: ValueError) -> LinkError:
    """What the rules of a link refused."""
    found = _OF_RULES.fullmatch(str(error))
    return LinkError(found["key"], found["problem"]) if found else LinkError("link", f": {error}")


_WORDS = {"float": "a number", "int": "a whole number", "str": "a string", "array": "a list", "object": "a table"}


def of_types(error: ValidationError, plain: dict[str, Any]) -> LinkError:
    """What the types of the settings refused."""
    said, _, where = str(error).partition(" - at `$")
    steps = [int(step[1:-1]) if step[0] == "[" else step[1:] for step in re.findall(r"\.[^.\[`]+|\[\d+\]", where)]
    seen: Any = plain
    for step in steps:
        seen = seen[step]
    key = ".".join(map(str, steps))
    if found := re.search(r"unknown field `(.*)`", said):
        return LinkError(".".join([*map(str, steps), found[1]]), ": there is no such setting")
    if found := re.search(r"missing required field `(.*)`", said):
        return LinkError(".".join([*map(str, steps), found[1]]), ": is missing")
    allowed = said.removeprefix("Expected ").partition(", got")[0].replace("`", "").replace(" | null", "")
    for name, words in _WORDS.items():
        allowed = re.sub(rf"\b{name}\b", words, allowed)
    return wrong(key or "link", seen, allowed)


def refuse_infinite(plain: object, key: str = "") -> None:
    """Refuses numbers that are not finite, which JSON cannot write.

    Raises:
        LinkError: With the place of the first.
    """
    if isinstance(plain, float) and not math.isfinite(plain):
        raise wrong(key, plain, "a finite number")
    items = plain.items() if isinstance(plain, dict) else enumerate(plain) if isinstance(plain, list | tuple) else ()
    for step, value in items:
        refuse_infinite(value, f"{key}.{step}" if key else f"{step}")
