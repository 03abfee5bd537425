"""Limits and random steps for the tests of streamed joint velocities."""

from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.slave import SelfKeepOut, StreamingLimits, WorkspacePlane, model_limits, ur_model

Array = npt.NDArray[np.float64]

PERIOD_S = 0.002
MODEL = ur_model("ur5e")
JOINTS = model_limits(MODEL)
TABLE = WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=0.0, whole_arm=True)
WALL = WorkspacePlane(normal=(-1.0, 0.0, 0.0), offset_m=-0.6)
LIMITS: dict[str, StreamingLimits] = {
    "none": StreamingLimits(),
    "joints": JOINTS,
    "position": StreamingLimits(position_min=MODEL.position_min, position_max=MODEL.position_max),
    "tool speed": StreamingLimits(max_tool_speed=0.4),
    "joints and tool speed": msgspec.structs.replace(JOINTS, max_tool_speed=0.4),
    "planes": StreamingLimits(planes=(TABLE, WALL)),
    "all": msgspec.structs.replace(
        JOINTS, max_tool_speed=0.4, planes=(TABLE, WALL), self_keep_out=SelfKeepOut(margin_m=0.02)
    ),
}


@dataclass(frozen=True)
class Step:
    """A random state within limits, and a requested motion."""

    q: Array
    qd: Array
    twist: Array


def steps(count: int, seed: int = 3) -> list[Step]:
    """Return postures in front of the arm, some of them at the ends of each joint's range."""
    draws = np.random.default_rng(seed)
    middle = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3))
    return [
        Step(middle + draws.normal(0, 0.5, 6), draws.normal(0, 0.05, 6), draws.normal(0, 1.5, 6)) for _ in range(count)
    ]
