"""Contact and rendering of a scene: stiffness of its loop, and effects that one spring does not cover."""

from math import sqrt
from typing import Any, Literal

import msgspec
from msgspec import Struct

from haptether.bridge import Scene, scene_json

DEFAULT_FORCE_N = 7.9
"""Force limit in N of a scene without one: that of a PHANTOM Desktop."""

Spring = tuple[float, float]
"""K in N/m and B in N s/m."""
Rendered = Literal["force", "torque", "trigger"]


class Touched(Struct, frozen=True, kw_only=True):
    """Contact as `F = K d + B d'` against a rigid ground."""

    stiffness: float
    """K in N/m (N m/rad for joints): the stiffest contact plus all permanent springs."""
    damping: float
    """B of the same in N s/m (N m s/rad for joints)."""
    beyond: tuple[str, ...]
    """Contacts that such a spring does not describe, each with the reason."""


def scene_numbers(scene: Scene) -> dict[str, Any]:
    """Return all numbers of a scene, with presets and defaults filled in."""
    spec: dict[str, Any] = msgspec.json.decode(scene_json(scene))
    return spec


def touched(scene: Scene, spec: dict[str, Any]) -> Touched:
    """Return K and B of a scene's objects, holes and handles, and the contacts beyond a spring.

    Args:
        scene: Scene of any kind.
        spec: Result of `scene_numbers`.
    """
    springs, walls = contacts(spec)
    stiffest = max([(0.0, 0.0), *walls])
    return Touched(
        stiffness=sum(k for k, _ in springs) + stiffest[0],
        damping=sum(b for _, b in springs) + stiffest[1],
        beyond=tuple(_beyond(scene, spec["environment"] or {})) if spec["slave"] is not None else (),
    )


def contacts(spec: dict[str, Any]) -> tuple[list[Spring], list[Spring]]:
    """Return K and B of each permanent spring of a scene, and of each contact.

    A nonlinear law counts with its slope at the largest rendered force, `dF/dd = n F / d` of `F = K d^n`.

    Args:
        spec: Result of `scene_numbers`.

    Source: Hunt and Crossley 1975.
    """
    environment, slave = spec["environment"] or {}, spec["slave"]
    force_n = largest_force_n(spec)
    springs: list[Spring] = []
    walls: list[Spring] = []
    for part in (*environment.get("objects", ()), *environment.get("holes", ())):
        contact = part["contact"]
        stiffness, damping = contact["stiffness"], contact["damping"]
        if contact["law"] == "hunt-crossley" and stiffness > 0.0:
            exponent = contact["exponent"]
            stiffness = exponent * force_n / (force_n / stiffness) ** (1.0 / exponent)
            damping *= force_n
        is_spring = "shape" in part and part["shape"]["kind"] == "spring"
        (springs if is_spring else walls).append((stiffness, damping))
    # A held handle yields along its circle only; critically damped with the tool's mass (slave/src/tool/handle.rs).
    walls += [
        (part["hold_stiffness"], 2.0 * sqrt(part["hold_stiffness"] * slave["mass_kg"]))
        for part in environment.get("handles", ())
    ]
    return springs, walls


def largest_force_n(spec: dict[str, Any]) -> float:
    """Return the largest contact force in N that the limiter allows to be rendered."""
    limiter, device_n = spec["safety"]["limiter"], spec["master"]["max_force_n"]
    force_n: float = (device_n or DEFAULT_FORCE_N) if limiter is None else limiter["max_force_n"]
    return force_n / largest_scale(spec, "force_scale") if spec["slave"] is not None else force_n


def largest_scale(spec: dict[str, Any], key: str) -> float:
    """Return the largest value of a coupling scale, including changes."""
    coupling = spec["coupling"]
    return float(max(state[key] for state in (coupling, *coupling["changes"]) if state[key] is not None))


def _beyond(scene: Scene, environment: dict[str, Any]) -> list[str]:
    """Return the contacts that one spring along an axis does not describe."""
    slave = scene.slave
    assert slave is not None
    said = []
    if slave.device != "simulated" and not environment:
        said.append("the scene does not say what a real arm touches")
    if slave.tool is not None and len(slave.tool.points) > 1 and environment.get("objects"):
        said.append("a tool of several points touches with several at once, and is turned")
    if environment.get("holes"):
        said.append("a hole touches a tool at several points at once, and turns it")
    if environment.get("handles"):
        said.append("a handle turns with the tool")
    if environment.get("bodies"):
        said.append("a body that jaws hold moves with the arm")
    if any(part["body"] is not None for part in environment.get("objects", ())):
        said.append("an object slides away with its mass")
    if scene.master.gripper is not None and slave.gripper is not None:
        said.append("jaws are felt at a trigger")
    return said


def rendered(scene: Scene, spec: dict[str, Any]) -> frozenset[Rendered]:
    """Return the possible pushes on the device: a force, a torque on a rotating handle, a trigger force, or none.

    A real arm may touch whatever is there. The peer of a real device, and attacks on the way back, may send any force.
    """
    slave, master, coupling = scene.slave, scene.master, spec["coupling"]
    environment = spec["environment"] or {}
    if slave is None:
        return frozenset({"force"}) if environment.get("objects") or environment.get("pushers") else frozenset()
    link = spec["link"] or {}
    is_live = slave.device != "simulated" or master.driver is not None
    anything = is_live or bool((link.get("backward") or {}).get("attacks"))
    turned = anything or any(environment.get(kind) for kind in ("torques", "holes", "handles", "bodies"))
    if slave.tool is not None and (environment.get("objects") or environment.get("pushers")):
        # A force at the coupled point has no moment about it.
        turned |= any(map(any, slave.tool.points)) or coupling["reference_point"] is not None
    sensed = spec["slave"]["force_sensor"]
    pushed = anything or any(environment.get(kind) for kind in ("objects", "pushers", "holes", "handles", "bodies"))
    pushed |= sensed is not None and bool(sensed["noise_n"] or any(_axes(sensed["bias_n"])))
    found: set[Rendered] = set()
    if pushed and len(felt_axes(spec)) > 0:
        found.add("force")
    if turned and spec["master"]["kind"] == "pose" and not coupling["locks_rotation"]:
        found.add("torque")
    if master.gripper is not None and slave.gripper is not None:
        found.add("trigger")
    return frozenset(found)


def felt_axes(spec: dict[str, Any]) -> frozenset[int]:
    """Return the arm's axes whose force is felt at some time: those not locked throughout."""
    coupling = spec["coupling"]
    states = [state["locked_axes"] for state in (coupling, *coupling["changes"]) if state["locked_axes"] is not None]
    return frozenset(range(spec["master"]["axes"])) - set.intersection(*map(set, states))


def _axes(value: float | list[float]) -> list[float]:
    return value if isinstance(value, list) else [value]
