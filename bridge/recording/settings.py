"""Settings of a recording as tables that can be changed and checked again."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, cast

from msgspec import Meta, Struct, ValidationError, json

from haptether.bridge.scene.errors import Raw
from haptether.bridge.scene.load import checked, overridden
from haptether.bridge.scene.tables.session import Scene


class _Run(Struct):
    period_s: Annotated[float, Meta(gt=0.0)]


class _Master(Struct):
    kind: str
    mass_kg: list[float]
    viscous: list[float]
    coulomb: list[float]


class _Safety(Struct):
    limiter: Any


class _Settings(Struct):
    """Settings read here before the scene is checked."""

    run: _Run
    master: _Master
    slave: dict[str, Any]
    safety: _Safety
    coupling: dict[str, Any]


def check_settings(scene: bytes, name: str) -> None:
    """Refuse a recorded scene without the settings that a run needs.

    Args:
        scene: Scene bytes from a recording.
        name: File name for the message.

    Raises:
        ValueError: The scene is missing, or lacks a part.
    """
    if not scene:
        message = f"{name}: does not say with which scene it was run: there are no settings to run it with"
        raise ValueError(message)
    try:
        json.decode(scene, type=_Settings)
    except ValidationError as error:
        message = f"{name}: its scene is incomplete: {error}"
        raise ValueError(message) from None


def tables_of(scene: bytes, names: tuple[str, ...]) -> dict[str, Raw]:
    """Convert a resolved scene to the tables of a scene file; None values are omitted.

    Args:
        scene: Scene bytes from a recording.
        names: Table names; absent tables are omitted.
    """
    spec = cast("dict[str, Any]", json.decode(scene))
    tables: dict[str, Raw] = {"schema": 1}
    for name in names:
        if spec.get(name) is not None:
            tables[name] = _without_none(spec[name])
    if isinstance(safety := tables.get("safety"), dict) and spec["safety"]["limiter"] is None:
        safety["limiter"] = {"enabled": False}
    if isinstance(slave := tables.get("slave"), dict):
        # A position-controlled arm has no stiffness or damping of its own.
        for key in ("stiffness", "damping"):
            if not slave.get(key):
                slave.pop(key, None)
    if isinstance(operator := tables.get("operator"), dict):
        # Times that `clutch` named.
        times = operator.pop("clutch_times", None)
        if times is not None:
            operator["clutch"] = times
    if isinstance(environment := tables.get("environment"), dict):
        _drop_absent(environment)
    return tables


def recorded_scene(scene: bytes, overrides: Iterable[str] = ()) -> Scene:
    """Return the scene of a recording in a form that can be run again.

    Args:
        scene: Scene bytes from a recording.
        overrides: Fields to change, `table.key=value` each.

    Raises:
        SceneError: The scene is invalid.
    """
    raw = tables_of(scene, ("run", "master", "operator", "slave", "environment", "link", "coupling", "safety"))
    for override in overrides:
        raw = overridden(raw, override)
    return checked(raw, Path()).scene


def _drop_absent(environment: dict[str, Raw]) -> None:
    """Drop fields that the shape of a push does not have; they are stored as 0."""
    for key in ("pushers", "torques"):
        for push in cast("list[dict[str, Raw]]", environment.get(key, [])):
            for absent in ("frequency_hz", "rise_s"):
                if not push.get(absent):
                    push.pop(absent, None)


def _without_none(value: Raw) -> Raw:
    """Return a part of a scene without its None fields."""
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return [_without_none(part) for part in value] if isinstance(value, list) else value
