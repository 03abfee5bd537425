"""Loops of a scene for its design check: device, hand, arm and stiffest contact."""

import math
from typing import Any

from haptether.bridge import Scene
from haptether.studies.design.contact import felt_axes, largest_scale, scene_numbers, touched
from haptether.studies.design.delay import ContactLoop, Follower


def scene_loops(scene: Scene, wall_stiffness: float | None = None, *, held: bool = True) -> list[ContactLoop]:
    """One loop per felt axis: device, hand, arm and the stiffest contact.

    A nonlinear law counts with its slope at the largest rendered force.

    Args:
        scene: Scene with a [slave].
        wall_stiffness: Stiffness in N/m that replaces the contact. A scene without contact does not oscillate.
        held: True if the scene's hand holds the device.
    """
    spec = scene_numbers(scene)
    master, operator, coupling = spec["master"], spec["operator"] if held else None, spec["coupling"]
    found = touched(scene, spec)
    stiffness, damping = (found.stiffness, found.damping) if wall_stiffness is None else (wall_stiffness, 0.0)
    felt = felt_axes(spec)
    states = (coupling, *coupling["changes"])
    rotated = any(state["quat_wxyz"] not in (None, [1.0, 0.0, 0.0, 0.0]) for state in states)
    return [
        ContactLoop(
            mass_kg=mass_kg,
            damping=viscous + (operator["damping"] if operator else 0.0),
            hand_stiffness=operator["stiffness"] if operator else 0.0,
            environment_stiffness=stiffness,
            environment_damping=damping,
            force_scale=largest_scale(spec, "force_scale"),
            position_scale=largest_scale(spec, "position_scale"),
            follower=_arm(spec["slave"]),
        )
        for axis, (mass_kg, viscous) in enumerate(zip(master["mass_kg"], master["viscous"], strict=True))
        if rotated or axis in felt or not felt
    ]


def _arm(slave: dict[str, Any]) -> Follower:
    """Arm with the equivalent K_s and B_s of its control, as in `slave/src/arm/model.rs`."""
    mass_kg, pole = slave["mass_kg"], 2.0 * math.pi * slave["bandwidth_hz"]
    stiffness, damping = {
        "position": (mass_kg * pole**2, 2.0 * mass_kg * pole),
        "velocity": (0.25 * mass_kg * pole**2, mass_kg * pole),
        "pd": (slave["stiffness"], slave["damping"]),
    }[slave["control"]]
    return Follower(
        mass_kg=mass_kg, damping=damping, stiffness=stiffness, follows_velocity=slave["control"] != "position"
    )


def scene_times(scene: Scene) -> tuple[float, float]:
    """The longer period, and the silence in s after which the ladder holds."""
    spec = scene_numbers(scene)
    return max(spec["run"]["period_s"], spec["slave"]["period_s"]), spec["safety"]["ladder"]["hold_after_s"]
