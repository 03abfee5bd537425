"""Force Dimension models by SDK type, with published bounds.

Bounds: CHAI3D, src/devices/CDeltaDevices.cpp, values of that software; the maker's data sheets were not available. No
available source gives mass, friction or inertia; `haptether identify force-dimension` measures them.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Model(NamedTuple):
    """Published data of a model."""

    title: str
    max_force_n: float | None = None
    """None without a source."""
    max_torque_n_m: float | None = None
    max_gripper_force_n: float | None = None


_OMEGA = 12.0
_SIGMA7 = (12.0, 0.2, 8.0)
MODELS: Mapping[int, Model] = MappingProxyType({
    33: Model("omega.3", _OMEGA),
    34: Model("omega.6, right", _OMEGA),
    36: Model("omega.6, left", _OMEGA),
    35: Model("omega.7, right", _OMEGA, None, 8.0),
    37: Model("omega.7, left", _OMEGA, None, 8.0),
    63: Model("delta.3", 20.0),
    104: Model("sigma.7, right", *_SIGMA7),
    105: Model("sigma.7, left", *_SIGMA7),
})  # fmt: skip
"""Models by `dhdGetSystemType`. Source of the numbers: dhdc.h of SDK 3.17.5."""
