"""The bound on ejection speed, and who gets the force back after a trip, as commands say it."""

from collections.abc import Iterator
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


def release_line(scene: "Scene") -> str | None:
    """That no hand is asked for after a trip, where friction hides the probe that a scene has by default."""
    settings = scene.ejection_settings()
    asked = scene.safety.probe_force_n is not None or settings.probe_force_n > 0.0 or settings.damping == 0.0
    if asked or not settings.controllers:
        return None
    unit = "N m" if scene.master.kind == "joints" else "N"
    line = (
        f"friction of {max(settings.coulomb):g} {unit} hides a probe for a hand: "
        "after a trip the force comes back by time"
    )
    tries = settings.release_tries
    return f"{line}, {tries} times at most, and then a person must act" if tries else line


def announcement(scene: "Scene") -> Iterator[str]:
    """What is said before a loop begins: the greatest speed after a release, and who gets the force back."""
    try:
        bound = scene_bound(scene)
    except (ValueError, ArithmeticError) as error:
        # What is only said must not keep a side from running.
        yield f"no bound on the speed after a release: {error}"
        return
    if bound is not None:
        yield bound_line(scene, bound)
    if (line := release_line(scene)) is not None:
        yield line
