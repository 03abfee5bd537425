"""The bound on ejection speed, as commands say it."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import Scene
    from haptether.safety import EjectionBound


def scene_bound(scene: "Scene") -> "EjectionBound | None":
    """The bound of a scene; none where no controller watches."""
    from haptether.safety import ejection_bound

    return ejection_bound(scene) if scene.safety.controllers else None


def bound_line(scene: "Scene", bound: "EjectionBound") -> str:
    """The bound in one line, with what it holds under."""
    line = bound.text("rad/s" if scene.master.kind == "joints" else "m/s")
    return line if bound.speed is None else f"{line} ({'; '.join(bound.assumptions)})"


def announce_bound(scene: "Scene") -> None:
    """Says on standard error how fast the device can become after a release, where a controller watches."""
    bound = scene_bound(scene)
    if bound is not None:
        print(bound_line(scene, bound), file=sys.stderr, flush=True)
