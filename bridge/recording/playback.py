"""Scene that applies the recorded remote force to a new hand."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from haptether.bridge.recording.read import Recording, read_recording
from haptether.bridge.recording.settings import check_settings, tables_of
from haptether.bridge.scene.errors import Raw, SceneError
from haptether.bridge.scene.load import checked, overridden
from haptether.bridge.scene.tables.session import Scene

FORCES = {"master": "received_force", "slave": "environment_force"}
"""Signal that holds the remote force on each side."""
SETTLE_S = 1.0
"""Time in s that the run continues after the recording, so that the force fades out."""
OPERATOR: dict[str, Raw] = {"stiffness": 300.0, "damping": 8.0, "grip_strength_n": 12.0}
"""Firm hand that stays in place, used if the scene describes no operator."""


def playback_scene(file: str | os.PathLike[str] | Recording, *, overrides: Iterable[str] = ()) -> Scene:
    """Return a scene in which an arm has the recorded force from its engagement on, and nothing else acts on it.

    Coupling, safety layer, device and hand come from the recording; there is no network. The scene runs in virtual
    time, or live as the robot side to which any master engages. A live master engages by its operator's clutch, with
    force fade-in, safety layer, limiter and ladder.

    Args:
        file: File written by `--record` of master or slave, or the result of `read_recording`.
        overrides: Fields of the scene to change, `table.key=value` each.

    Raises:
        OSError: The file cannot be read.
        ValueError: The recording has no scene or no engagement, the coordinates are joints, or the scene is invalid.
    """
    recording = file if isinstance(file, Recording) else read_recording(file)
    name = recording.side if isinstance(file, Recording) else str(file)
    check_settings(recording.scene, name)
    time_s, force = _force(recording, name)
    raw = tables_of(recording.scene, ("run", "master", "operator", "slave", "safety", "coupling"))
    run, slave = cast("dict[str, Raw]", raw["run"]), cast("dict[str, Raw]", raw["slave"])
    run["duration_s"] = float(time_s[-1]) + SETTLE_S
    run["stop_early"] = False
    raw.setdefault("operator", dict(OPERATOR))
    # The recorded force already contains the sensor.
    slave.pop("force_sensor", None)
    series = {"time_s": time_s.tolist(), "values": force.tolist()}
    raw["environment"] = {"pushers": [{"shape": "recorded", "recorded": series}]}
    raw["record"] = {"every": 1}
    raw["title"] = "Playback"
    for override in overrides:
        raw = overridden(raw, override)
    try:
        return checked(raw, Path()).scene
    except SceneError as error:
        message = f"{name}: as a scene: {error}"
        raise SceneError(message) from None


def _force(recording: Recording, name: str) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the remote force in N since the engagement, shape `(n, axes)`, and its times in s."""
    signals, wanted = recording.signals, FORCES[recording.side]
    if wanted not in signals:
        message = f"{name}: has no {wanted}: it was written by Haptether {recording.version}, give that of the slave"
        raise ValueError(message)
    engaged = np.flatnonzero(signals["state"] == "engaged")
    if not len(engaged):
        message = f"{name}: the two sides never engaged, so that there is no force to play back"
        raise ValueError(message)
    time_s = (signals["time_ns"][engaged[0] :] - signals["time_ns"][engaged[0]]) * 1e-9
    force = np.nan_to_num(signals[wanted][engaged[0] :])
    if len(force) < 2:
        message = f"{name}: was engaged for one tick only, so that there is no force to play back"
        raise ValueError(message)
    # Drop points that equal both neighbours.
    same = (force[1:-1] == force[:-2]).all(axis=1) & (force[1:-1] == force[2:]).all(axis=1)
    kept = np.concatenate([[True], ~same, [True]])
    return time_s[kept], force[kept]
