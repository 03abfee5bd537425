"""A scene as the loops that its design is judged by: device, hand, arm and what is stiffest in it."""

import math
from typing import Any

import msgspec

from haptether.bridge import Scene, scene_json
from haptether.studies.design.delay import ContactLoop, Follower


def scene_loops(scene: Scene, wall_stiffness: float | None = None, *, held: bool = True) -> list[ContactLoop]:
    """The contact of a scene's device, hand and arm with what is stiffest in it, one loop for each axis that is felt.

    A law that is not linear counts with its slope where it pushes with the largest force that is rendered.

    Args:
        scene: One with a [slave].
        wall_stiffness: In N/m, of what is touched instead; where the scene touches nothing, nothing oscillates.
        held: Whether the scene's hand holds the device.
    """
    spec = scene_numbers(scene)
    master, operator, coupling = spec["master"], spec["operator"] if held else None, spec["coupling"]
    states = [coupling, *coupling["changes"]]
    force_scale, position_scale = (
        max(state[key] for state in states if state[key] is not None) for key in ("force_scale", "position_scale")
    )
    limiter = spec["safety"]["limiter"]
    max_force_n = DEFAULT_FORCE_N if limiter is None else limiter["max_force_n"]
    stiffness, damping = (
        contact_numbers(spec["environment"], max_force_n / force_scale)
        if wall_stiffness is None
        else (wall_stiffness, 0.0)
    )
    # What is locked from the first to the last change is never felt.
    locked = set.intersection(*(set(state["locked_axes"]) for state in states if state["locked_axes"] is not None))
    rotated = any(state["quat_wxyz"] not in (None, [1.0, 0.0, 0.0, 0.0]) for state in states)
    return [
        ContactLoop(
            mass_kg=mass_kg,
            damping=viscous + (operator["damping"] if operator else 0.0),
            hand_stiffness=operator["stiffness"] if operator else 0.0,
            environment_stiffness=stiffness,
            environment_damping=damping,
            force_scale=force_scale,
            position_scale=position_scale,
            follower=_arm(spec["slave"]),
        )
        for axis, (mass_kg, viscous) in enumerate(zip(master["mass_kg"], master["viscous"], strict=True))
        if rotated or axis not in locked or len(locked) == master["axes"]
    ]


DEFAULT_FORCE_N = 7.9
"""Where a scene bounds no force: what a PHANTOM Desktop exerts."""


def scene_numbers(scene: Scene) -> dict[str, Any]:
    """All numbers of a scene, with presets and defaults filled in."""
    spec: dict[str, Any] = msgspec.json.decode(scene_json(scene))
    return spec


def _arm(slave: dict[str, Any]) -> Follower:
    """K_s and B_s that a control amounts to, as `slave/src/arm/model.rs` has them."""
    mass_kg, pole = slave["mass_kg"], 2.0 * math.pi * slave["bandwidth_hz"]
    stiffness, damping = {
        "position": (mass_kg * pole**2, 2.0 * mass_kg * pole),
        "velocity": (0.25 * mass_kg * pole**2, mass_kg * pole),
        "pd": (slave["stiffness"], slave["damping"]),
    }[slave["control"]]
    return Follower(
        mass_kg=mass_kg, damping=damping, stiffness=stiffness, follows_velocity=slave["control"] != "position"
    )


def contact_numbers(environment: dict[str, Any] | None, force_n: float) -> tuple[float, float]:
    """K in N/m and B in N s/m of what is stiffest, and of the springs that act all the time."""
    springs, stiffest = [(0.0, 0.0)], (0.0, 0.0)
    for part in environment["objects"] if environment else []:
        contact = part["contact"]
        stiffness, damping, exponent = contact["stiffness"], contact["damping"], contact["exponent"]
        if part["shape"]["kind"] == "spring":
            springs.append((stiffness, damping))
            continue
        if contact["law"] == "hunt-crossley" and stiffness > 0.0:
            # F = K d^n: n F / d, and its damping chi F.
            stiffness = exponent * force_n / (force_n / stiffness) ** (1.0 / exponent)
            damping *= force_n
        stiffest = max(stiffest, (stiffness, damping))
    return sum(k for k, _ in springs) + stiffest[0], sum(b for _, b in springs) + stiffest[1]


def scene_times(scene: Scene) -> tuple[float, float]:
    """The longer of the two sides' periods, and the silence in s after which the ladder holds."""
    spec = scene_numbers(scene)
    return max(spec["run"]["period_s"], spec["slave"]["period_s"]), spec["safety"]["ladder"]["hold_after_s"]
