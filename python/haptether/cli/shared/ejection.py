"""The bound on ejection speed, as commands say it."""

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


def announcement(scene: "Scene") -> str | None:
    """How fast the device can become after a release, where a controller watches; computed before a loop begins."""
    try:
        bound = scene_bound(scene)
    except (ValueError, ArithmeticError) as error:
        # What is only said must not keep a side from running.
        return f"no bound on the speed after a release: {error}"
    return None if bound is None else bound_line(scene, bound)
