"""Export of a scene as TOML that reads back as the same scene."""

import json
from os import PathLike
from pathlib import Path as FilePath
from typing import Any

import msgspec

from haptether.bridge.scene.tables.session import Scene
from haptether.private_file import refuse_link, write_private

LINE = 100
"""Longest inline table in characters; a longer table gets its own section."""


def scene_toml(scene: Scene, comment: str = "") -> str:
    """Return the scene as text without default values, below `comment`, one line each."""
    raw = msgspec.to_builtins(scene)
    lines = [f"# {line}".rstrip() for line in comment.splitlines()]
    lines += [f"{name} = {toml_value(value)}" for name, value in raw.items() if not isinstance(value, dict)]
    for name, table in raw.items():
        if isinstance(table, dict):
            lines += _table(name, table)
    return "\n".join(lines) + "\n"


def save_scene(scene: Scene, path: str | PathLike[str], comment: str = "") -> None:
    """Write the scene with mode 0600.

    Args:
        scene: Scene to write.
        path: Target TOML file, which is replaced.
        comment: Text above the tables.

    Raises:
        OSError: The file cannot be written, or is a symbolic link.
    """
    target = FilePath(path)
    refuse_link(target)
    write_private(target, scene_toml(scene, comment).encode())


def _table(name: str, table: dict[str, Any]) -> list[str]:
    """Return a table, then its subtables; small ones inline."""
    own, below = [], []
    for key, value in table.items():
        if value is None:
            continue
        line = f"{_key(key)} = {toml_value(value)}"
        path = f"{name}.{_key(key)}"
        if _is_list_of_tables(value):
            for each in value:
                _, head, *rest = _table(path, each)
                below += ["", f"[{head}]", *rest]
        elif isinstance(value, dict) and len(line) > LINE:
            below += _table(path, value)
        else:
            own.append(line)
    return ["", f"[{name}]", *own, *below]


def _is_list_of_tables(value: object) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(each, dict) for each in value)


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)


def toml_value(value: Any) -> str:  # noqa: ANN401  # any field
    """Format an inline value."""
    if isinstance(value, dict):
        parts = (f"{_key(key)} = {toml_value(each)}" for key, each in value.items() if each is not None)
        return f"{{ {', '.join(parts)} }}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, str | bool):
        # JSON and TOML use the same escapes.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
