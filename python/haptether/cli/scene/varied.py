"""Parsing of `--vary` and `--draw` of a sweep: paths with values, and paths with laws."""

import contextlib
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from haptether.bridge.scene.errors import Raw
    from haptether.bridge.scene.sweeps.laws import SampleLaw

RANGE = re.compile(r"[^:,\[{'\"]*:[^:,]*:[^:,]*")
"""`a:b:n`, not a list, a table or a text."""


def spelled(path: str) -> str:
    """Return a path as scenes spell it: "-" may stand for "_".

    Raises:
        SceneError: A path that is not in the schema.
    """
    from haptether.bridge.scene.load import path_of
    from haptether.bridge.scene.sweeps.scenes import SCENE

    return path if path == SCENE else ".".join(map(str, path_of(path)))


def values_of(text: str) -> tuple[str, list[Any]]:
    """Return the path and the values of `path=a:b:n` or `path=v1,v2,...`.

    Raises:
        ValueError: Another form, or a count that is invalid or too large.
        SceneError: A value other than a number for a path that is not in the schema, or in no form of TOML.
    """
    import math

    import numpy as np

    from haptether.bridge import SceneError
    from haptether.bridge.scene.sweeps.limits import check_rows
    from haptether.bridge.scene.sweeps.scenes import SCENE

    path, _, values = text.partition("=")
    check_rows({f"--vary {text}": count_of(text)})
    found: list[Any] = []
    try:
        if RANGE.fullmatch(values):
            first, last, count = values.split(":")
            if not math.isfinite(float(last) - float(first)):
                raise ValueError
            found = np.linspace(float(first), float(last), int(count)).tolist()
        else:
            found = [_unquoted(item.strip()) if path == SCENE else _value_of(path, item) for item in _items(values)]
        if not all(math.isfinite(value) for value in found if isinstance(value, float)):
            raise ValueError
    except SceneError:
        raise
    except ValueError:
        found = []
    if not path or not found:
        message = (
            f"--vary {text}: must be path=a:b:n with n of at least 1, or path=v1,v2,... of finite numbers or of what"
            " else the field takes"
        )
        raise ValueError(message)
    return path, found


def count_of(text: str) -> int:
    """Return how many values `path=a:b:n` or `path=v1,v2,...` has; 1 for other forms."""
    values = text.partition("=")[2]
    with contextlib.suppress(ValueError):
        return int(values.rpartition(":")[2]) if RANGE.fullmatch(values) else len(_items(values))
    return 1


def _items(text: str) -> list[str]:
    """Split a text at the commas outside of brackets and quotes."""
    items, depth, quoted = [""], 0, ""
    for letter in text:
        if letter == "," and depth == 0 and not quoted:
            items.append("")
            continue
        if letter in "'\"":
            quoted = "" if quoted == letter else quoted or letter
        elif not quoted:
            depth += (letter in "[{") - (letter in "]}")
        items[-1] += letter
    if "" in map(str.strip, items):
        raise ValueError
    return items


def _unquoted(item: str) -> str:
    """Remove a matching pair of quotes around the whole text."""
    quote = item[:1]
    return item[1:-1] if quote in {"'", '"'} and len(item) > 2 and item.find(quote, 1) == len(item) - 1 else item


def _value_of(path: str, item: str) -> "Raw":
    import math

    from msgspec import inspect

    from haptether.bridge.scene.errors import types_at
    from haptether.bridge.scene.load import path_of, toml_value
    from haptether.bridge.scene.sweeps.limits import LARGEST_EXACT

    try:
        number = float(item)
    except ValueError:
        if ":" in item and not item.strip().startswith(("[", "{", "'", '"')):
            raise
    else:
        if math.isfinite(number) and abs(number) > LARGEST_EXACT:
            # A rounded number would hide why it is refused.
            with contextlib.suppress(ValueError):
                return int(item)
        return number
    steps = path_of(path)
    if item.strip() == "none" and any(isinstance(kind, inspect.VarTupleType) for kind in types_at(steps)):
        return []
    return toml_value(item.strip(), steps)


def drawn_law(text: str) -> "tuple[str, SampleLaw]":
    """Return the path and the law of `path=law:...`.

    Raises:
        ValueError: Another form, or numbers that the law does not take.
    """
    from haptether.bridge.scene.sweeps.laws import FORMS, law_of

    path, _, law = text.partition("=")
    if not path or not law:
        message = f"--draw {text}: must be path=law, the law one of {FORMS}"
        raise ValueError(message)
    path = spelled(path)
    try:
        return path, law_of(law)
    except ValueError as error:
        message = f"--draw {path}: {error}"
        raise ValueError(message) from None
