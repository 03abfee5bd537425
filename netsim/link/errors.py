"""One-line link errors: setting, value seen, values allowed."""

import math
import re
from typing import Any

from msgspec import Struct, ValidationError, inspect


class LinkError(ValueError):
    """Invalid settings of a link.

    Args:
        key: Setting with its path, such as `outages.0.times.period_s`.
        problem: Text after the key: ` = seen: must be allowed`, or `: error`.
    """

    def __init__(self, key: str, problem: str) -> None:
        super().__init__(f"{key}{problem}")
        self.key = key
        self.problem = problem
        """Message without the key."""


def wrong(key: str, seen: object, allowed: str) -> LinkError:
    """Return the error for a value that is not allowed."""
    text = f'"{seen}"' if isinstance(seen, str) else f"{seen}"
    return LinkError(key, f" = {text if len(text) <= 80 else f'{text[:76]} ...'}: must be {allowed}")


_OF_RULES = re.compile(r"(?P<key>[\w.]+)(?P<problem>(?: = |: ).*)", re.DOTALL)


def of_rules(error: ValueError) -> LinkError:
    """Convert an error of the link rules."""
    found = _OF_RULES.fullmatch(str(error))
    return LinkError(found["key"], found["problem"]) if found else LinkError("link", f": {error}")


def of_types(error: ValidationError, raw: dict[str, Any], root: type[Struct]) -> LinkError:
    """Convert an error of the settings' types."""
    message, _, where = str(error).partition(" - at `$")
    steps = [int(step[1:-1]) if step[0] == "[" else step[1:] for step in re.findall(r"\.[^.\[`]+|\[\d+\]", where)]
    key = ".".join(map(str, steps))
    if found := re.search(r"unknown field `(.*)`", message):
        return LinkError(f"{key}.{found[1]}".lstrip("."), ": there is no such setting")
    if found := re.search(r"missing required field `(.*)`", message):
        return LinkError(f"{key}.{found[1]}".lstrip("."), ": is missing")
    seen: Any = raw
    for step in steps:
        seen = seen[step]
    allowed = " or ".join(dict.fromkeys(text for kind in _types_at(root, steps) if (text := _range_text(kind))))
    return wrong(key or "link", seen, allowed or "left out")


def _members(kind: inspect.Type) -> tuple[inspect.Type, ...]:
    while isinstance(kind, inspect.Metadata):
        kind = kind.type
    return kind.types if isinstance(kind, inspect.UnionType) else (kind,)


def _types_at(root: type[Struct], steps: list[str | int]) -> tuple[inspect.Type, ...]:
    kinds: tuple[inspect.Type, ...] = (inspect.type_info(root),)
    for step in steps:
        inner: list[inspect.Type] = []
        for kind in kinds:
            if isinstance(kind, inspect.StructType):
                inner += [part for field in kind.fields if field.name == step for part in _members(field.type)]
            elif isinstance(kind, inspect.VarTupleType):
                inner += _members(kind.item_type)
        kinds = tuple(inner)
    return kinds


def _range_text(kind: inspect.Type) -> str:  # noqa: PLR0911  # one for each type
    match kind:
        case inspect.FloatType() | inspect.IntType():
            number = "a whole number" if isinstance(kind, inspect.IntType) else "a number"
            if kind.ge is not None:
                return f"{number} from {kind.ge:g} to {kind.le:g}"
            return f"{number} above {kind.gt:g} and at most {kind.le:g}"
        case inspect.LiteralType():
            return f"one of {', '.join(map(str, kind.values))}"
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType():
            return "a string"
        case inspect.VarTupleType():
            return "a list"
        case inspect.StructType():
            return "a table" if kind.tag is None else f"a table of kind {kind.tag}"
        case _:
            return ""


def refuse_infinite(raw: object, key: str = "") -> None:
    """Refuse numbers that are not finite, which JSON cannot represent.

    Raises:
        LinkError: Gives the path of the first.
    """
    if isinstance(raw, float) and not math.isfinite(raw):
        raise wrong(key, raw, "a finite number")
    items = raw.items() if isinstance(raw, dict) else enumerate(raw) if isinstance(raw, list | tuple) else ()
    for step, value in items:
        refuse_infinite(value, f"{key}.{step}" if key else f"{step}")
