"""The settings that a recording was made with, as tables that can be changed and checked again."""

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
    """Settings that are read here before the scene is checked."""

    run: _Run
    master: _Master
    slave: dict[str, Any]
    safety: _Safety
    coupling: dict[str, Any]


def check_settings(scene: bytes, name: str) -> None:
    """Refuses a recorded scene without the settings that a run needs.

    Args:
        scene: As a recording keeps it.
        name: Name of its file.

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
    """Tables of a scene as it was resolved, in the form of a scene's file: what is none is left out.

    Args:
        scene: As a recording keeps it.
        names: Of the tables; those that the scene does not have are left out.
    """
    spec = cast("dict[str, Any]", json.decode(scene))
    tables: dict[str, Raw] = {"schema": 1}
    for name in names:
        if spec.get(name) is not None:
            tables[name] = _without_none(spec[name])
    if isinstance(safety := tables.get("safety"), dict) and spec["safety"]["limiter"] is None:
        safety["limiter"] = {"enabled": False}
    if isinstance(slave := tables.get("slave"), dict):
        # Of an arm that is led by positions, which has none of its own.
        for key in ("stiffness", "damping"):
            if not slave.get(key):
                slave.pop(key, None)
    if isinstance(operator := tables.get("operator"), dict):
        # What `clutch` names.
        times = operator.pop("clutch_times", None)
        if times is not None:
            operator["clutch"] = times
    if isinstance(environment := tables.get("environment"), dict):
        _drop_absent(environment)
    return tables


def recorded_scene(scene: bytes, overrides: Iterable[str] = ()) -> Scene:
    """The scene of a recording, as a scene that can be run again.

    Args:
        scene: As a recording keeps it.
        overrides: Fields to change, `table.key=value` each.

    Raises:
        SceneError: One that cannot be built.
    """
    raw = tables_of(scene, ("run", "master", "operator", "slave", "environment", "link", "coupling", "safety"))
    for override in overrides:
        raw = overridden(raw, override)
    return checked(raw, Path()).scene


def _drop_absent(environment: dict[str, Raw]) -> None:
    """Drops what a push of its shape does not have, which stands as 0."""
    for key in ("pushers", "torques"):
        for push in cast("list[dict[str, Raw]]", environment.get(key, [])):
            for absent in ("frequency_hz", "rise_s"):
                if not push.get(absent):
                    push.pop(absent, None)


def _without_none(value: Raw) -> Raw:
    """A part of a scene without its fields that are none."""
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return [_without_none(part) for part in value] if isinstance(value, list) else value
