"""The bound on ejection speed, and how the force returns after a trip, as commands print them."""

from collections.abc import Iterator
from math import inf
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import Scene
    from haptether.safety import EjectionBound, EjectionSettings


def cancels(settings: "EjectionSettings") -> bool:
    """True if an intervention of any controller takes the force away."""
    from haptether._core import CANCELLING

    return not set(CANCELLING).isdisjoint(settings.controllers)


def scene_bound(scene: "Scene", free_s: float | None = None) -> "EjectionBound | None":
    """Return the bound of a scene, by default to the end of its run; None without a controller."""
    from haptether.safety import ejection_bound

    return ejection_bound(scene, free_s=free_s) if scene.safety.controllers else None


def bound_line(scene: "Scene", bound: "EjectionBound") -> str:
    """Return the bound in one line, with its assumptions."""
    line = bound.text("rad/s" if _is_of_joints(scene) else "m/s")
    return line if bound.speed is None else f"{line} ({'; '.join(bound.assumptions)})"


def _is_of_joints(scene: "Scene") -> bool:
    from haptether.bridge.scene.resolve import side_kind

    return side_kind(scene.master) == "joints"


def release_line(scene: "Scene") -> str | None:
    """Return the line that names how the force returns after a trip without a probe for a hand; None with a probe."""
    settings = scene.ejection_settings()
    if not cancels(settings) or settings.probe_force_n > 0.0:
        return None
    unit = "N m" if _is_of_joints(scene) else "N"
    if scene.safety.probe_force_n is not None:
        why = "probe_force_n = 0"
    elif settings.damping == 0.0:
        why = "without damping there is no probe for a hand"
    else:
        friction, cap = max(settings.coulomb), settings.max_force_n
        why = f"friction of {friction:g} {unit} and a cap of {cap:g} {unit} leave no room to probe for a hand"
    if not settings.release_tries:
        return f"{why}: after a trip the force comes back by time"
    if settings.damping > 0.0:
        return f"{why}: after a trip the force comes back to one that moves the device"
    until = "" if scene.slave is None else " until a person presses the clutch"
    return f"{why}: after a trip the force stays away{until}"


def force_returns_by(scene: "Scene") -> str:
    """Return what restores the force after a trip: a "hand" that answers or moves, "time", or "never"."""
    settings = scene.ejection_settings()
    if settings.probe_force_n > 0.0:
        return "hand"
    if not settings.release_tries:
        return "time"
    return "hand" if settings.damping > 0.0 else "never"


def release_law(scene: "Scene") -> dict[str, object] | None:
    """Return how the force returns after a trip, for machines; None without a controller that removes it."""
    settings = scene.ejection_settings()
    if not cancels(settings):
        return None
    return {
        "probe_force": settings.probe_force_n,
        "release_tries": settings.release_tries,
        "hold_off_s": scene.safety.hold_off_s,
        "release_ramp_s": settings.release_ramp_s,
        "returns": force_returns_by(scene),
        "remark": release_line(scene),
    }


def announcement(scene: "Scene") -> Iterator[str]:
    """Yield the lines before a loop begins: the greatest speed after a release, and how the force returns."""
    try:
        bound = scene_bound(scene, free_s=inf)
    except (ValueError, ArithmeticError) as error:
        # A missing bound must not keep a side from running.
        yield f"no bound on the speed after a release: {error}"
        return
    if bound is not None:
        yield bound_line(scene, bound)
    if (line := release_line(scene)) is not None:
        yield line
