"""Loading of scenes: read by name or path, override, check and convert for the Rust side."""

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from os import PathLike
from pathlib import Path as FilePath
from typing import TypeAlias, cast

import msgspec
from msgspec import inspect

from haptether.bridge.scene.checks import checked_spec
from haptether.bridge.scene.errors import (
    Path,
    Raw,
    SceneError,
    abridged,
    closest,
    explained,
    place,
    refuse_infinite,
    shown,
    table_type,
    types_at,
    unknown_key,
)
from haptether.bridge.scene.research import with_own_controllers
from haptether.bridge.scene.resolve import Spec
from haptether.bridge.scene.series import embed_recordings
from haptether.bridge.scene.tables.session import Scene
from haptether.input_file import read_text

Leaf: TypeAlias = "float | int | str | bool | None"
"""Field value of a scene without parts."""

_SHIPPED = FilePath(__file__).parents[1] / "scenes"
MAX_BYTES = 1 << 18
"""Largest scene file."""
MAX_PARTS = 12
"""Largest number of parts of a dotted key; the schema has 6. The TOML reader's memory grows with their square."""
_PART = r"(?:[\w-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_PARTS}}}")
_BARE_WORD = re.compile(r"(?<![\"\w.+-])(?!(?:true|false)\b)([A-Za-z_][\w-]*)(?![\"\w])")


def scene_names(*, attacks: bool = False) -> tuple[str, ...]:
    """Return the names of the shipped scenes, on request with the attacks of `haptether raven`."""
    return tuple(sorted(path.stem for path in _SHIPPED.glob("**/*.toml" if attacks else "*.toml")))


@dataclass(frozen=True)
class Checked:
    """Valid scene and its specification for the Rust side."""

    scene: Scene
    spec: Spec

    @cached_property
    def json(self) -> bytes:
        """The same scene gives the same bytes."""
        return msgspec.json.encode(self.spec)


def load_scene(name_or_path: str | PathLike[str], overrides: Iterable[str] = ()) -> Scene:
    """Read a scene.

    Args:
        name_or_path: One of `scene_names(attacks=True)`, or the path of a TOML file.
        overrides: `table.key=value` each, in TOML; bare words are strings. `operator.legs.0.end=-0.03` reaches into a
            list.

    Returns:
        The checked scene, with the recordings that it names embedded.

    Raises:
        SceneError: The scene does not exist or is invalid; gives file, table, key, value seen, values allowed.
    """
    return loaded(name_or_path, overrides).scene


def loaded(name_or_path: str | PathLike[str], overrides: Iterable[str] = ()) -> Checked:
    """Return the result of `load_scene` with its specification for the Rust side."""
    path, overrides = scene_path(name_or_path), override_texts(overrides)
    try:
        raw = _tables(scene_text(path))
        for override in overrides:
            raw = overridden(raw, override)
        return checked(raw, path.parent)
    except tomllib.TOMLDecodeError as error:
        message = f"{path.name}: {_with_line(error)}"
    except SceneError as error:
        message = f"{path.name}: {error}"
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
    except RecursionError:
        message = f"{path.name}: tables or lists too deep within each other"
    raise SceneError(message)


def scene_text(path: FilePath) -> str:
    """Return the text of a scene file within the size limit.

    Raises:
        SceneError: Not a plain file, too long, or another encoding. The message omits the path.
        OSError: The file cannot be read.
    """
    try:
        return read_text(path, MAX_BYTES)
    except ValueError as error:
        raise SceneError(str(error)) from None


def _refuse_long_keys(text: str) -> None:
    if found := _LONG_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        message = f"line {line}: {shown(found[0])}: a key of more than {MAX_PARTS} parts"
        raise SceneError(message)


def _tables(text: str) -> dict[str, Raw]:
    _refuse_long_keys(text)
    try:
        return cast("dict[str, Raw]", tomllib.loads(text))
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:
        # Python rejects numbers of thousands of digits and invalid dates.
        message = f"a number or a date that cannot be: {str(error).partition(';')[0]}"
        raise SceneError(message) from None


def scene_path(name_or_path: str | PathLike[str]) -> FilePath:
    """Return the path of a scene.

    Raises:
        SceneError: The scene does not exist; names the closest match.
    """
    if not isinstance(name_or_path, str | PathLike):
        message = (
            f"scene = {shown(name_or_path)}: must be the name of a shipped scene or the path of a TOML file;"
            " `simulate` and `sweep` take a Scene, too"
        )
        raise SceneError(message)
    if isinstance(name_or_path, str) and name_or_path in scene_names(attacks=True):
        return next(_SHIPPED.glob(f"**/{name_or_path}.toml"))
    if name_or_path == "":
        message = 'scene = "": must be the name of a shipped scene or the path of a TOML file'
        raise SceneError(message)
    path = FilePath(name_or_path)
    if path.is_dir():
        message = f"{path}: is a folder, must be the name of a shipped scene or a TOML file"
        raise SceneError(message)
    if not path.exists():
        message = f"{path}: no shipped scene and no such file: {closest(path.stem, scene_names())}"
        raise SceneError(message)
    return path


def _with_line(error: tomllib.TOMLDecodeError) -> str:
    found = re.fullmatch(r"(.*?) \(at (.*)\)", str(error), re.DOTALL)
    return f"{found[2]}: {found[1]}" if found else str(error)


def checked(raw: Raw, folder: FilePath) -> Checked:
    """Check a scene in the form of TOML tables; files that it names are relative to `folder`.

    Raises:
        SceneError: The scene is invalid.
    """
    refuse_infinite(raw)
    scene = embed_recordings(typed_scene(raw), folder)
    return Checked(scene, checked_spec(scene))


def typed_scene(raw: Raw) -> Scene:
    """Convert to a scene with finite numbers, checked for types and ranges only.

    Raises:
        SceneError: A key, type or range violates the schema.
    """
    raw = with_own_controllers(raw)
    try:
        return msgspec.convert(raw, Scene)
    except msgspec.ValidationError as error:
        raise explained(error, raw) from None


def override_scene(scene: Scene, overrides: Iterable[str]) -> Scene:
    """Return a scene with changed fields, each `table.key=value`.

    Raises:
        SceneError: A path is not in the schema, or the scene is invalid.
    """
    return checked_scene(scene, overrides).scene


def scene_json(scene: Scene) -> bytes:
    """Return the scene as JSON with exactly the fields of `bridge/src/scene/spec.rs`; defaults are filled in.

    The same scene gives the same bytes.

    Raises:
        SceneError: The scene is invalid.
    """
    return checked_scene(scene).json


_KEPT: dict[bytes, Checked] = {}
_MOST_KEPT = 8
_LONGEST_KEPT = 1 << 20
"""Largest scene in bytes that is cached, which excludes long recordings."""


def checked_scene(scene: Scene, overrides: Iterable[str] = ()) -> Checked:
    """Return the result of `override_scene` with its specification for the Rust side.

    The latest results are cached, because the checks take longer than a short run.
    """
    overrides = override_texts(overrides)
    try:
        # MessagePack distinguishes non-finite numbers from absent ones.
        key = b"" if overrides else msgspec.msgpack.encode(scene)
    except (OverflowError, TypeError, ValueError, RecursionError):
        key = b""  # the checks report the error
    if (kept := _KEPT.get(key)) is not None:
        return kept
    found = _checked_again(scene, overrides)
    # A scene that names files changes with them, so do not cache it.
    if 0 < len(key) < _LONGEST_KEPT and msgspec.msgpack.encode(found.scene) == key:
        while len(_KEPT) >= _MOST_KEPT:
            _KEPT.pop(next(iter(_KEPT)), None)
        _KEPT[key] = found
    return found


def _checked_again(scene: Scene, overrides: Iterable[str]) -> Checked:
    # A struct built in Python has not been checked for its ranges yet.
    raw = cast("dict[str, Raw]", msgspec.to_builtins(scene))
    for override in overrides:
        raw = overridden(raw, override)
    return checked(raw, FilePath())


# ------------------------------------------------------------------------------------------------ overrides


def override_texts(overrides: Iterable[str]) -> tuple[str, ...]:
    """Return the overrides as a tuple of texts for `overridden`.

    Raises:
        SceneError: The value is not a list of texts.
    """
    if isinstance(overrides, Iterable) and not isinstance(overrides, str | bytes | Mapping):
        overrides = tuple(overrides)
        if all(isinstance(override, str) for override in overrides):
            return overrides
    message = f'overrides = {shown(overrides)}: must be a list of texts, such as ["run.seed=3"]'
    raise SceneError(message)


def overridden(raw: dict[str, Raw], override: str) -> dict[str, Raw]:
    """Return a copy of the tables with one field changed by `table.key=value`.

    File paths are relative to the working folder.

    Raises:
        SceneError: `=` is missing, the path is not in the schema, or the value is not valid TOML.
    """
    key, equals, text = override.partition("=")
    if not equals:
        message = f"{shown(override)}: must be table.key=value"
        raise SceneError(message)
    path = path_of(key.strip())
    value = of_working_folder(toml_value(text.strip(), path), path[-1] if path else "")
    return cast("dict[str, Raw]", with_value(raw, path, value))


def of_working_folder(value: Raw, key: str | int = "") -> Raw:
    """Return a value with each relative file path in it joined to the working folder."""
    if isinstance(value, dict):
        return {name: of_working_folder(one, name) for name, one in value.items()}
    if isinstance(value, list):
        return [of_working_folder(one) for one in value]
    if isinstance(value, str) and (key == "file" or (key == "distribution" and value.endswith(".dist"))):
        return str(FilePath(value).absolute())
    return value


def leaf_values(tree: object, path: str = "") -> Iterator[tuple[str, Leaf]]:
    """Yield the values of nested tables and lists in order, each with its dotted path, prefixed by `path`."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from leaf_values(value, f"{path}.{key}" if path else key)
    elif isinstance(tree, list | tuple):
        for index, value in enumerate(tree):
            yield from leaf_values(value, f"{path}.{index}")
    else:
        yield path, cast("Leaf", tree)


@lru_cache(maxsize=256)
def path_of(text: str) -> Path:
    """Parse `operator.legs.0.end` as a path of the schema; `-` may replace `_`.

    Raises:
        SceneError: The path is not in the schema; names the closest match.
    """
    written = text.split(".")
    path: Path = tuple(int(step) if re.fullmatch(r"\d{1,9}", step) else step.replace("-", "_") for step in written)
    for length in range(1, len(path) + 1):
        if not types_at(path[:length]):
            if table_type(path[: length - 1]) is not None:
                raise unknown_key(path[:length])
            message = f"{shown(text)}: {place(path[: length - 1])} has no part {abridged(written[length - 1])}"
            if types_at((*path[: length - 1], 0)):
                message += ": parts are counted from 0"
            raise SceneError(message)
    return path


def toml_value(text: str, path: Path) -> Raw:
    """Parse a TOML value; unquoted words are strings, also inside a list.

    Raises:
        SceneError: The text is not valid TOML.
    """
    _refuse_long_keys(text)
    candidates = [text]
    if text in {"true", "false"} and not any(
        # Driver options have unknown types, so TOML decides.
        isinstance(kind, inspect.BoolType | inspect.AnyType)
        for kind in types_at(path)
    ):
        # String option that looks like a boolean, `safety.signals=true`.
        candidates = [f'"{text}"']
    elif re.fullmatch(r"[\w./:-]+", text) or (not text and inspect.AnyType in map(type, types_at(path))):
        # An address with a port, or nothing after the sign, is for the driver to refuse.
        candidates.append(f'"{text}"')
    elif text.startswith(("[", "{")):
        candidates.append(_BARE_WORD.sub(r'"\1"', text))
    for candidate in candidates:
        try:
            raw = tomllib.loads(f"value = {candidate}")
        except tomllib.TOMLDecodeError:
            continue
        if len(raw) == 1:
            return cast("Raw", raw["value"])
    message = f"{place(path)} = {shown(text)}: must be a value in TOML"
    raise SceneError(message)


def with_value(raw: Raw, path: Path, value: Raw, at: Path = ()) -> Raw:
    """Set a value at a path of the schema in raw tables, and create missing tables on the way.

    Raises:
        SceneError: An index is outside the list of the scene.
    """
    if not path:
        return value
    step, rest = path[0], path[1:]
    if isinstance(step, int):
        if isinstance(raw, int | float):
            message = f"{place((*at, step))}: the scene has one number for all axes: name it without the axis"
            raise SceneError(message)
        if not isinstance(raw, list | tuple) or step >= len(raw):
            count = len(raw) if isinstance(raw, list | tuple) else 0
            message = f"{place((*at, step))}: the scene has {count} of these, counted from 0"
            raise SceneError(message)
        return [with_value(item, rest, value, (*at, step)) if index == step else item for index, item in enumerate(raw)]
    table = dict(raw) if isinstance(raw, dict) else _default_table(at)
    table[step] = with_value(table.get(step), rest, value, (*at, step))
    return table


def _default_table(path: Path) -> dict[str, Raw]:
    """Return the table at a path that the scene omits; only its kind matters, because its fields have defaults."""
    parents = table_type(path[:-1]) if path else None
    for field in (field for parent in parents or () for field in parent.fields if field.name == path[-1]):
        if isinstance(field.default, msgspec.Struct):
            return cast("dict[str, Raw]", msgspec.to_builtins(field.default))
    return {}
