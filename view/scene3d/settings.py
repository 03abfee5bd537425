"""The scene of a run from its settings in a recording or in telemetry."""

from collections.abc import Mapping
from typing import Any

import msgspec
from msgspec import inspect

from haptether.bridge import MasterTable, Scene

LOOKED_AT: Mapping[str, frozenset[str] | None] = {
    "master": frozenset({"kind", "axes", "stops"}),
    "operator": None,
    "slave": frozenset({"tool"}),
    "environment": frozenset({"objects", "holes", "handles", "bodies"}),
    "safety": frozenset({"controllers", "grasp_threshold", "energy_threshold_j"}),
}
"""Tables and fields that are drawn; all of "operator", whose presence counts."""


def scene_of_settings(settings: Mapping[str, Any] | None) -> Scene | None:
    """Drawn part of a scene from its settings, with defaults; None without settings.

    Settings do not name the driven device; `Arms` does.

    Args:
        settings: `Run.settings` or `TelemetryHello.scene`.
    """
    if not settings:
        return None
    kept: dict[str, Any] = {"schema": 1}
    for field in _fields(Scene):
        if field.name in LOOKED_AT and settings.get(field.name) is not None:
            allowed = LOOKED_AT[field.name]
            table = {
                key: value for key, value in settings[field.name].items() if allowed is None or key in allowed
            }  # fmt: skip
            kept[field.name] = _fitted(table, field.type)
    try:
        return msgspec.convert(kept, Scene)
    except msgspec.ValidationError:
        # Settings of another version: the number of axes suffices to draw the motion.
        return Scene(schema=1, master=msgspec.convert({"axes": settings["master"]["axes"]}, MasterTable))


def _fields(table: type[msgspec.Struct]) -> tuple[inspect.Field, ...]:
    kind = inspect.type_info(table)
    assert isinstance(kind, inspect.StructType)
    return kind.fields


def _fitted(value: Any, kind: inspect.Type) -> Any:  # noqa: ANN401  # any field
    """Value as a table accepts it, without fields for the loops only and without empty fields."""
    if isinstance(kind, inspect.Metadata):
        return _fitted(value, kind.type)
    if isinstance(kind, inspect.UnionType):
        tables = [one for one in kind.types if isinstance(one, inspect.StructType)]
        if isinstance(value, dict) and tables:
            named = [one for one in tables if one.tag_field and one.tag == value.get(one.tag_field)]
            return _fitted(value, (named or tables)[0])
        plain = [one.type if isinstance(one, inspect.Metadata) else one for one in kind.types]
        lists = [one for one in plain if isinstance(one, inspect.VarTupleType)]
        return _fitted(value, lists[0]) if isinstance(value, list) and lists else value
    if isinstance(kind, inspect.StructType) and isinstance(value, dict):
        known = {field.name: field.type for field in kind.fields}
        fitted = {name: _fitted(one, known[name]) for name, one in value.items() if name in known and one is not None}
        return fitted | ({kind.tag_field: kind.tag} if kind.tag_field else {})
    if isinstance(kind, inspect.VarTupleType) and isinstance(value, list):
        return [_fitted(one, kind.item_type) for one in value]
    return value
