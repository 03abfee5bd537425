"""Scenes of an aimed hand before a soft wall."""

from typing import Any

import msgspec
from tests.scene.two_sides import PRESS

from haptether.bridge import Scene

HAND = {"stiffness": 300.0, "damping": 8.0, "strength_n": 12.0}
"""A firm hand."""


def aim(at_s: float, target: float, over_s: float = 0.1, **hand: float) -> dict[str, Any]:
    """Return one row of `[operator.aims]`."""
    return {"at_s": at_s, "target": target, "over_s": over_s, **HAND, **hand}


def aimed(*rows: dict[str, Any], **operator: Any) -> Scene:  # noqa: ANN401  # keys of a table
    """Return the scene of two sides whose hand follows aims; without rows, those of a person."""
    hand = {"start": 0.02, "clutch": "once", "aims": {"rows": rows}, **operator}
    return msgspec.convert({**PRESS, "operator": hand}, Scene)
