"""A recording as a scene: the remote force that was recorded acts on a hand again, whatever that does."""

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
"""What each side recorded of the remote force."""
SETTLE_S = 1.0
"""How long the run goes on after the recording, so that the force has faded."""
OPERATOR: dict[str, Raw] = {"stiffness": 300.0, "damping": 8.0, "grip_strength_n": 12.0}
"""A firm hand that stays where it is, in place of a person's that no scene describes."""


def playback_scene(file: str | os.PathLike[str] | Recording, *, overrides: Iterable[str] = ()) -> Scene:
    """The scene in which an arm has the force of a recording, from its engagement on, and nothing else acts on it.

    Coupling, safety layer, device and hand are those of the recording, the network is none. It runs in virtual time as
    any scene, and live as the side of the robot, to which any master engages: by a person's clutch, with the force
    faded in, under safety layer, limiter and ladder.

    Args:
        file: What `--record` of master or slave wrote, or what `read_recording` read of it.
        overrides: Fields of the scene to change, `table.key=value` each.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is no recording with a scene and an engagement; joints; a scene that cannot be.
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
    # What was recorded has been through a sensor.
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
    """The remote force in N since the engagement, shape `(n, axes)`, and its times in s."""
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
    # A point that lies on the line between its neighbours says nothing.
    same = (force[1:-1] == force[:-2]).all(axis=1) & (force[1:-1] == force[2:]).all(axis=1)
    kept = np.concatenate([[True], ~same, [True]])
    return time_s[kept], force[kept]
