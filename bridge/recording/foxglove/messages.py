"""Poses, frames and force arrows of one recorded side as messages in Foxglove's schemas."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from haptether.bridge.recording.foxglove.schemas import (
    FRAME_TRANSFORMS,
    POSE_IN_FRAME,
    PRIMITIVES,
    SCENE_UPDATE,
    Json,
)
from haptether.bridge.recording.read import Recording
from haptether.view.style.colours import SIGNALS

Array = npt.NDArray[Any]

INTERVAL_NS = 10_000_000
"""Interval of poses and arrows in ns; the tick with the largest force in an interval represents it."""
WORLD = "haptether"
"""Common parent frame of both bases."""
METRES_PER_NEWTON = 0.01
LEAST_N = 0.05
"""Smallest force in N that is drawn."""
ARROWS = {
    "master": {"rendered_force": SIGNALS["rendered"], "device_force": SIGNALS["hand"]},
    "slave": {"environment_force": SIGNALS["arm"]},
}
"""Forces drawn at each end, in the colours that all pictures use."""


class FoxgloveMessage(NamedTuple):
    """Message with topic, schema and time."""

    topic: str
    schema: Json
    time_ns: int
    """Wall clock time."""
    content: Json


def messages_of(recording: Recording, begun_ns: int) -> Iterator[FoxgloveMessage]:
    """Yield the messages, in time order, of a side whose run began at wall clock time `begun_ns`.

    Raises:
        ValueError: The recorded coordinates have no position in three dimensions.
    """
    side, signals = recording.side, recording.signals
    time_ns, position = signals["time_ns"], _points(recording)
    if not len(time_ns):
        return
    forces = {name: _spatial(signals[name]) for name in ARROWS[side] if name in signals}
    largest = np.max([np.linalg.norm(np.nan_to_num(force), axis=1) for force in forces.values()], axis=0)
    begins = np.flatnonzero(np.diff(time_ns // INTERVAL_NS, prepend=-1))
    for begin, end in zip(begins, [*begins[1:], len(time_ns)], strict=True):
        # The tick with the largest force represents the interval.
        tick = int(begin + np.argmax(largest[begin:end]))
        if not np.isfinite(position[tick]).all():
            continue
        at_ns = begun_ns + int(time_ns[tick])
        stamp = _stamp(at_ns)
        pose = {"position": _vector(position[tick]), "orientation": _orientation(signals, tick)}
        base = f"{side}_base"
        transforms = [
            _transform(stamp, WORLD, base, _vector(np.zeros(3)), _quaternion(np.array([1.0, 0.0, 0.0, 0.0]))),
            _transform(stamp, base, side, pose["position"], pose["orientation"]),
        ]
        yield FoxgloveMessage("/tf", FRAME_TRANSFORMS, at_ns, {"transforms": transforms})
        yield FoxgloveMessage(
            f"/{side}/pose", POSE_IN_FRAME, at_ns, {"timestamp": stamp, "frame_id": base, "pose": pose}
        )
        arrows = [
            arrow
            for name, force in forces.items()
            if (arrow := _arrow(position[tick], force[tick], ARROWS[side][name])) is not None
        ]
        yield FoxgloveMessage(f"/{side}/forces", SCENE_UPDATE, at_ns, _update(stamp, base, side, arrows))


def _points(recording: Recording) -> Array:
    signals = recording.signals
    position = signals.get("true_position", signals["position"])
    if recording.scene:
        from msgspec import json  # noqa: PLC0415

        kind = (json.decode(recording.scene).get("master") or {}).get("kind")
        if kind == "joints":
            message = f'{recording.side}: kind = "joints": angles have no place in three dimensions'
            raise ValueError(message)
    if position.ndim == 2 and position.shape[1] > 3:
        message = f"{recording.side}: {position.shape[1]} axes: at most three have a place in three dimensions"
        raise ValueError(message)
    return _spatial(position)


def _spatial(values: Array) -> Array:
    """Extend one to three axes to x, y, z."""
    there = np.zeros((len(values), 3))
    there[:, : values.shape[1] if values.ndim == 2 else 1] = values.reshape(len(values), -1)
    return there


def _stamp(time_ns: int) -> Json:
    return {"sec": time_ns // 1_000_000_000, "nsec": time_ns % 1_000_000_000}


def _vector(values: Array) -> Json:
    return dict(zip("xyz", (float(value) for value in values), strict=True))


def _quaternion(quat_wxyz: Array) -> Json:
    w, x, y, z = (float(part) for part in quat_wxyz)
    return {"x": x, "y": y, "z": z, "w": w}


def _orientation(signals: dict[str, Array], tick: int) -> Json:
    turned = signals.get("true_orientation", signals.get("orientation"))
    return _quaternion(np.array([1.0, 0.0, 0.0, 0.0]) if turned is None else turned[tick])


def _transform(stamp: Json, parent: str, child: str, translation: Json, rotation: Json) -> Json:
    return {
        "timestamp": stamp,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": translation,
        "rotation": rotation,
    }


def _arrow(tail: Array, force: Array, colour: str) -> Json | None:
    newtons = float(np.linalg.norm(force))
    if not math.isfinite(newtons) or newtons < LEAST_N:
        return None
    length = newtons * METRES_PER_NEWTON
    red, green, blue = (byte / 255.0 for byte in bytes.fromhex(colour.removeprefix("#")))
    return {
        "pose": {"position": _vector(tail), "orientation": _quaternion(_from_x(force / newtons))},
        "shaft_length": 0.8 * length,
        "shaft_diameter": 0.004,
        "head_length": 0.2 * length,
        "head_diameter": 0.009,
        "color": {"r": red, "g": green, "b": blue, "a": 1.0},
    }


def _from_x(direction: Array) -> Array:
    """Return the quaternion w, x, y, z of the shortest rotation from +x to a direction."""
    x, y, z = direction
    if x < -1.0 + 1e-12:
        return np.array([0.0, 0.0, 0.0, 1.0])
    quat = np.array([1.0 + x, 0.0, -z, y])
    return quat / float(np.linalg.norm(quat))


def _update(stamp: Json, base: str, side: str, arrows: list[Json]) -> Json:
    entity = {
        "timestamp": stamp,
        "frame_id": base,
        "id": f"{side}_forces",
        "lifetime": {"sec": 0, "nsec": 0},
        "frame_locked": True,
        "metadata": [],
        **{name: [] for name in PRIMITIVES},
        "arrows": arrows,
    }
    return {"deletions": [], "entities": [entity]}
