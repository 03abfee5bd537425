"""One-line scene errors: location, value seen, values allowed."""

import difflib
import math
import re
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import TypeAlias, cast

from msgspec import ValidationError, inspect

from haptether.bridge.devices.find import OWN_CONTROLLERS
from haptether.bridge.scene.tables.session import Scene
from haptether.printable import printable

Raw: TypeAlias = "dict[str, Raw] | list[Raw] | tuple[Raw, ...] | str | int | float | bool | None"
"""Value from TOML, or from a scene converted to built-in types."""
Path: TypeAlias = tuple[str | int, ...]
"""Location in a scene: table keys and list indices."""


WHOLE = "a whole number"
"""Allowed value of an integer field, for messages."""


class SceneError(ValueError):
    """Scene that cannot be built. The message is one line: file, table, key, value seen, values allowed."""


def place(path: Path) -> str:
    """Format `("operator", "legs", 0, "end", 1)` as `[operator.legs.0] end.1`; a top-level key as itself."""
    table: Path = ()
    for length in range(1, len(path)):
        if not isinstance(path[length], int) and table_type(path[:length]) is not None:
            table = path[:length]
    key = _dotted(path[len(table) :])
    return f"[{_dotted(table)}] {key}" if table else key


def _dotted(path: Path) -> str:
    return ".".join(abridged(str(step)) for step in path)


def abridged(text: str) -> str:
    """Make text from a file safe for one line: escape unprintable characters and cut long text."""
    text = text if len(text) <= 80 else f"{text[:76]} ..."
    return printable(text)


def wrong(path: Path, seen: object, allowed: str) -> SceneError:
    """Return the error for a value that is not allowed."""
    # Keep the decimal point if an integer is required: 1.0 is not 1.
    text = repr(seen) if isinstance(seen, float) and allowed.startswith(WHOLE) else shown(seen)
    return SceneError(f"{place(path)} = {text}: must be {allowed}")


def contradiction(path: Path, problem: str) -> SceneError:
    """Return the error for a part that contradicts another."""
    return SceneError(f"{place(path)}: {problem}")


def shown(value: object) -> str:
    """Format a value as TOML; long values are abridged."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        text = f'"{value}"'
    elif isinstance(value, list | tuple):
        text = f"[{', '.join(map(shown, value[:9]))}{', ...' if len(value) > 9 else ''}]"
    elif isinstance(value, dict):
        text = f"{{{', '.join(f'{key} = {shown(item)}' for key, item in value.items())}}}"
    elif isinstance(value, float):
        text = f"{value:g}" if float(f"{value:g}") == value else repr(value)
    else:
        text = str(value)
    return abridged(text)


def closest(word: str, words: Iterable[str]) -> str:
    """Return a question with the most similar word, or list all words if none is similar."""
    words = sorted(words)
    near = difflib.get_close_matches(word[:80], words, n=1, cutoff=0.5)
    return f"did you mean {near[0]}?" if near else f"there is {', '.join(words)}"


# ---------------------------------------------------------------------------------------------- types of a path


def members(kind: inspect.Type) -> tuple[inspect.Type, ...]:
    """Return the alternatives of a union, or the single type, without annotations."""
    if isinstance(kind, inspect.Metadata):
        return members(kind.type)
    return (
        tuple(one for part in kind.types for one in members(part)) if isinstance(kind, inspect.UnionType) else (kind,)
    )


def _inside(kinds: Iterable[inspect.Type], step: str | int) -> Iterator[inspect.Type]:
    for kind in kinds:
        if isinstance(kind, inspect.StructType) and isinstance(step, str):
            if step == kind.tag_field:
                yield inspect.StrType()
            yield from (part for field in kind.fields if field.name == step for part in members(field.type))
        elif isinstance(kind, inspect.VarTupleType) and isinstance(step, int):
            yield from members(kind.item_type)
        elif isinstance(kind, inspect.DictType) and isinstance(step, str):
            yield from members(kind.value_type)
        elif isinstance(kind, inspect.AnyType):
            yield kind


_ROOT = inspect.type_info(Scene)


@lru_cache(maxsize=256)
def types_at(path: Path) -> tuple[inspect.Type, ...]:
    """Return the types allowed at a path; empty if the schema has no such path."""
    kinds: tuple[inspect.Type, ...] = (_ROOT,)
    for step in path:
        kinds = tuple(_inside(kinds, step))
    return kinds


def table_type(path: Path) -> tuple[inspect.StructType, ...] | None:
    """Return the tables allowed at a path, or None."""
    return tuple(kind for kind in types_at(path) if isinstance(kind, inspect.StructType)) or None


def keys_at(path: Path) -> set[str]:
    """Return the keys of a table at a path."""
    tables = table_type(path) or ()
    keys = {field.name for table in tables for field in table.fields}
    return keys | {table.tag_field for table in tables if table.tag_field is not None}


def allowed_at(path: Path, seen: Raw = None) -> str:
    """Describe the values allowed at a path; if `seen` has the wrong type, name the right one."""
    if path[-1] == "kind" and (tagged := [table for table in table_type(path[:-1]) or () if table.tag_field == "kind"]):
        return f"one of {_choices(table.tag for table in tagged)}"
    tables = table_type(path)
    if tables and len(tables) > 1:
        return f"a table whose {tables[0].tag_field} is one of {_choices(table.tag for table in tables)}"
    words = [word for kind in types_at(path) if (word := _words(kind))]
    return ", ".join(filter(None, (_number_due(path, seen), " or ".join(dict.fromkeys(words))))) or "left out"


def _number_due(path: Path, seen: Raw) -> str:
    """Return the required kind of number if `seen` is not a number; empty if it is, or if other types are allowed."""
    kinds = types_at(path)
    is_number = isinstance(seen, int | float) and not isinstance(seen, bool)
    if any(isinstance(kind, inspect.IntType) for kind in kinds):
        return WHOLE if seen is not None and (isinstance(seen, float) or not is_number) else ""
    others = inspect.StrType | inspect.BoolType | inspect.LiteralType | inspect.VarTupleType | inspect.DictType
    if seen is None or is_number or any(isinstance(kind, others) for kind in kinds):
        return ""
    return "a number" if any(isinstance(kind, inspect.FloatType) for kind in kinds) else ""


def _choices(values: Iterable[object]) -> str:
    return ", ".join(shown(value) for value in values)


def _words(kind: inspect.Type) -> str:  # noqa: PLR0911  # one for each type
    match kind:
        case inspect.FloatType() | inspect.IntType():
            return _range(kind.gt, kind.ge, kind.lt, kind.le)
        case inspect.LiteralType(values=(only,)):
            return shown(only)
        case inspect.LiteralType(values=values):
            return f"one of {_choices(values)}"
        case inspect.VarTupleType(item_type=inspect.StructType()):
            return "a list of tables"
        case inspect.VarTupleType(min_length=2, max_length=2):
            return "a list of 2 such values"
        case inspect.VarTupleType(item_type=inspect.LiteralType(values=values)):
            return f"a list of any of {_choices(values)}"
        case inspect.VarTupleType():
            return "a list of such values" if kind.min_length is None else "a list with one value per axis"
        case inspect.StructType() | inspect.DictType():
            return "a table"
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType():
            return "a string"
        case _:
            return ""


def _range(gt: float | None, ge: float | None, lt: float | None, le: float | None) -> str:
    if ge is not None and le is not None:
        return f"{bound(ge)} to {bound(le)}"
    limits = (("above", gt), ("at least", ge), ("below", lt), ("at most", le))
    return " and ".join(f"{word} {bound(limit)}" for word, limit in limits if limit is not None)


def bound(value: float) -> str:
    """Format a bound exactly and as short as possible."""
    return f"{value:.10g}" if abs(value) < 1e7 else f"{value:g}".replace("e+0", "e")


# ------------------------------------------------------------------------------------------------- refusals


def look_up(raw: Raw, path: Path) -> Raw:
    """Return the raw value at a path."""
    for step in path:
        raw = cast("dict[str | int, Raw]", raw)[step]
    return raw


def refuse_infinite(raw: Raw, path: Path = ()) -> None:
    """Refuse numbers that are not finite.

    Raises:
        SceneError: Gives the location of the first.
    """
    if isinstance(raw, dict):
        for key, value in raw.items():
            refuse_infinite(value, (*path, key))
    elif isinstance(raw, list | tuple):
        for index, value in enumerate(raw):
            refuse_infinite(value, (*path, index))
    elif isinstance(raw, float) and not math.isfinite(raw):
        raise wrong(path, raw, "a finite number")


REMOVED: dict[Path, str] = {
    ("run", "integrator"): "the stepped integrators were removed, leave the key out",
    ("run", "step_s"): "was removed with the stepped integrators, leave it out",
    ("master", "friction_speed"): "was removed with the stepped integrators, leave it out",
}
"""Keys, or values of a key, of earlier versions, with the replacement."""

_WHERE = re.compile(r"(?P<said>.*?)(?: - at `\$(?P<path>.*)`)?$", re.DOTALL)


def explained(error: ValidationError, raw: Raw) -> SceneError:
    """Return the schema error with the value seen and the types allowed."""
    found = _WHERE.match(str(error))
    said, where = (found["said"], found["path"] or "") if found else (str(error), "")
    if not where and not isinstance(raw, dict):
        return SceneError(f"scene = {shown(raw)}: must be a Scene; load_scene makes one of a name or a file")
    path: Path = tuple(
        int(step[1:-1]) if step.startswith("[") else step.removeprefix(".")
        for step in re.findall(r"\.[^.\[]+|\[\d+\]", where)
    )
    if unknown := re.search(r"unknown field `(.*)`", said, re.DOTALL):
        return unknown_key((*path, unknown[1]))
    if missing := re.search(r"missing required field `(.*)`", said):
        key = missing[1]
        return SceneError(f"{place((*path, key))} is missing: must be {allowed_at((*path, key))}")
    seen = look_up(raw, path)
    own = OWN_CONTROLLERS if path[:2] == ("safety", "controllers") and isinstance(seen, str) else None
    return wrong(path, seen, ": ".join(filter(None, (allowed_at(path, seen), REMOVED.get(path), own))))


def unknown_key(path: Path) -> SceneError:
    """Return the error for an unknown key."""
    if path in REMOVED:
        return contradiction(path, REMOVED[path])
    key, table = str(path[-1]), path[:-1]
    name = f"[{_dotted(table)}]" if table else "a scene"
    seen = abridged(key) or '""'
    return SceneError(f"{name} has no key {seen}: {closest(key, keys_at(table))}")
