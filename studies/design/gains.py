"""Gains of couplings for a pair of devices and its link: stated, advised, or tried by a press."""

from collections.abc import Iterator
from math import inf
from typing import Any

import msgspec
from msgspec import Struct

from haptether.bridge import COUPLINGS, CouplingFacts, Scene, SceneError, coupling_facts, override_scene
from haptether.studies.design.contact import largest_force_n, largest_scale, scene_numbers, touched
from haptether.studies.design.coupled import coupled_delays, coupled_loops, virtual_tool
from haptether.studies.design.finding import MARGIN, Intervals, link_delays_s, rounded_down, rounded_up
from haptether.studies.design.press import FAILED, OUTCOMES, Outcome, Press, Stroke, press, stroke

DAMPING_MARGIN = 1.3
"""Ratio of an advised B to the least with which the coupling is passive."""
MOST_DAMPING = 0.3
"""Largest B in units of M/T: more, held for a tick, turns a motion around."""
DRAG_N, DRAG_SPEED, DRAG_SPEED_OF_JOINTS = 2.0, 0.3, 1.0
"""Largest force of the dampers in free motion, at these speeds in m/s and rad/s; at most a quarter of the cap."""
SOFTER = 0.8
"""Step of the search for a stiffness that is stable."""
STEPS = 24
DEFAULT_MASS_KG = 0.157
"""Mass in kg of the device for which the default gains are."""
SHARES = (4.0, 2.0, 1.0, 0.5, 0.25)
"""Gains that are tried for a pair, as shares of the defaults for its mass; the largest B of them is below 0.3 M/T. A
damper that the hand feels in free motion is at most the default."""
GAINS = (
    "stiffness", "damping", "rotational_stiffness", "rotational_damping", "impedance", "start_energy_j", "spread_s",
    "environment_gain", "grasp_gain", "play_out_s",
)  # fmt: skip
"""Keys of [coupling] that only some kinds use."""


class PressedCoupling(Struct, frozen=True, kw_only=True):
    """Press of a pair under a coupling with gains for the pair."""

    kind: str
    changes: tuple[str, ...]
    """Overrides that set it."""
    presses: tuple[Press, ...]
    """One for each seed, up to the first that does not rest."""
    strokes: tuple[Stroke, ...]
    """The same."""

    @property
    def press(self) -> Press:
        """Press with the seed of the scene."""
        return self.presses[0]

    @property
    def outcome(self) -> Outcome:
        """Worst outcome of the presses and strokes that the ladder does not interrupt; "held" if it interrupts all."""
        outcomes = {one.outcome for one in self.presses} | {one.outcome for one in self.strokes}
        return next(outcome for outcome in OUTCOMES if outcome in outcomes)


class AdvisedCoupling(Struct, frozen=True, kw_only=True):
    """Coupling that is passive and stable over a link."""

    kind: str
    stiffness: float
    """K in N/m (N m/rad)."""
    damping: float
    """B in N s/m (N m s/rad)."""
    stable: Intervals
    """Intervals of the sum of both delays in s, in which it is stable."""

    @property
    def changes(self) -> tuple[str, ...]:
        """Overrides that set it."""
        return (
            f"coupling.kind={self.kind}",
            f"coupling.stiffness={self.stiffness:g}",
            f"coupling.damping={self.damping:g}",
        )


def has_halves(spec: dict[str, Any]) -> bool:
    """Return True if a scene's coupling has two halves; False without an arm, and for measured position-force."""
    return spec["slave"] is not None and coupling_facts(spec["coupling"]["kind"]).stiffness is not None


def facts_of(spec: dict[str, Any], round_trip_s: float = 0.0) -> CouplingFacts:
    """Return the facts of a scene's coupling at a round trip in s, with the gains of the scene."""
    coupling = spec["coupling"]
    return coupling_facts(
        coupling["kind"],
        stiffness=coupling["stiffness"],
        damping=coupling["damping"],
        impedance=coupling["impedance"],
        spread_s=coupling["spread_s"],
        round_trip_s=round_trip_s,
        period_s=longest_period_s(spec),
    )


def longest_period_s(spec: dict[str, Any]) -> float:
    """Return the longer period of the two sides in s."""
    return float(max(spec["run"]["period_s"], spec["slave"]["period_s"]))


def stated_gains(spec: dict[str, Any]) -> tuple[float, float]:
    """Return K and B of a scene's coupling with two halves."""
    facts = facts_of(spec)
    assert facts.stiffness is not None, "position-force has no gains"
    assert facts.damping is not None
    return facts.stiffness, facts.damping


def least_damping_of(kind: str, stiffness: float, delay_s: float, spec: dict[str, Any]) -> float | None:
    """Return the least B with which a coupling is passive."""
    facts = coupling_facts(kind, stiffness=stiffness, round_trip_s=delay_s, period_s=longest_period_s(spec))
    return facts.least_damping


def advised_coupling(scene: Scene, up_to_s: float, kinds: tuple[str, ...] = ()) -> AdvisedCoupling | None:
    """Return the stiffest coupling that is passive and stable over a scene's link, or None.

    B is `DAMPING_MARGIN` times the least, and K the largest with `B <= 0.3 M/T` for device and virtual tool and with
    `B V <= 2 N` in free motion. It is lowered until held, let go, in free motion and on each contact the delay that 1 %
    exceed is stable with margin.

    Args:
        scene: Scene with a [slave], not of kind "pose".
        up_to_s: Largest delay in s that is examined.
        kinds: Names of the couplings that are tried; by default all.
    """
    spec = scene_numbers(scene)
    delays = link_delays_s(spec)
    if delays is None or spec["master"]["kind"] == "pose":
        return None
    most = _most_damping(spec, virtual_tool(spec).mass_kg)
    best: AdvisedCoupling | None = None
    for name, *_ in COUPLINGS:
        per = least_damping_of(name, 1.0, delays[1], spec)
        if per is None or coupling_facts(name).keeps_ledger or (kinds and name not in kinds):
            continue
        stiffness = rounded_down(most / (DAMPING_MARGIN * per))
        for _ in range(STEPS):
            if best is not None and stiffness <= best.stiffness:
                break
            damping = rounded_up(DAMPING_MARGIN * per * stiffness)
            tried = AdvisedCoupling(kind=name, stiffness=stiffness, damping=damping, stable=())
            try:
                stable = _stable(override_scene(scene, tried.changes), up_to_s)
            except SceneError:
                break
            if any(low <= delays[0] and delays[1] * MARGIN <= high for low, high in stable):
                best = AdvisedCoupling(kind=name, stiffness=stiffness, damping=damping, stable=stable)
                break
            stiffness = rounded_down(SOFTER * stiffness)
    return best


def held_damping(spec: dict[str, Any], tool_kg: float = inf) -> float:
    """Return the largest damping in N s/m that the device, and a tool, bear: it is held for a tick."""
    scale = largest_scale(spec, "force_scale") * largest_scale(spec, "position_scale")
    return float(MOST_DAMPING * min(min(spec["master"]["mass_kg"]) / scale, tool_kg) / longest_period_s(spec))


def softer_gains(spec: dict[str, Any], stiffness: float, damping: float) -> Iterator[tuple[str, ...]]:
    """Yield softer gains of a coupling that no linear loop describes, with a B between `K dT` and 0.3 M/T."""
    kind = spec["coupling"]["kind"]
    most = held_damping(spec, virtual_tool(spec).mass_kg)
    per = least_damping_of(kind, 1.0, 0.0, spec) or longest_period_s(spec)
    stiffest = most / (2.0 * DAMPING_MARGIN * per)
    for share in (1.0, 0.5, 0.2, 0.1):
        softer = min(share * stiffness, share * stiffest)
        weaker = min(max(share * damping, DAMPING_MARGIN * per * softer), most)
        changes = [f"coupling.stiffness={rounded_down(softer):g}", f"coupling.damping={rounded_up(weaker):g}"]
        if kind == "wave":
            changes.append(f"coupling.impedance={rounded_down(share * _most_damping(spec)):g}")
        yield tuple(changes)


def _most_damping(spec: dict[str, Any], tool_kg: float = inf) -> float:
    """Return the largest damping in N s/m that the device, and a tool, bear and that a hand tolerates."""
    scale = largest_scale(spec, "force_scale") * largest_scale(spec, "position_scale")
    speed = DRAG_SPEED_OF_JOINTS if spec["master"]["kind"] == "joints" else DRAG_SPEED
    drag_n = min(DRAG_N, 0.25 * largest_force_n(spec) * largest_scale(spec, "force_scale"))
    return float(min(held_damping(spec, tool_kg), drag_n / speed / scale))


def advised_waves(scene: Scene) -> tuple[float, float] | None:
    """Return the largest impedance b of waves that a device bears, in N s/m, and their stiffness 1/C in N/m; or None.

    Args:
        scene: Scene with a [slave]; None unless its kind is linear, for which the gains of waves are measured.
    """
    spec = scene_numbers(scene)
    delays = link_delays_s(spec)
    if delays is None or spec["master"]["kind"] != "linear":
        return None
    impedance = rounded_down(_most_damping(spec))
    facts = coupling_facts("wave", impedance=impedance, round_trip_s=delays[0], period_s=longest_period_s(spec))
    return impedance, 1.0 / (facts.compliance or inf)


def pressed_couplings(
    scene: Scene, up_to_s: float, kinds: tuple[str, ...] = (), wall: float | None = None, seeds: int = 1
) -> Iterator[PressedCoupling]:
    """Press the pair of a scene under each coupling, over its link, without a controller.

    Gains are those that `advised_coupling` and `advised_waves` find, else the defaults times mass of the device over
    `DEFAULT_MASS_KG`, each of `SHARES` until press and stroke rest with all seeds. Gains do not mend a link over which
    the ladder holds.

    Args:
        scene: Scene with a [slave].
        up_to_s: Largest delay in s that is examined.
        kinds: Names of the couplings; by default all.
        wall: Stiffness of the wall in N/m (N m/rad); by default the stiffest of the scene.
        seeds: Number of seeds of the network, from that of the scene on.
    """
    spec = scene_numbers(scene)
    wall = touched(scene, spec).stiffness if wall is None else wall
    bare = without_gains(scene)
    for kind, *_ in COUPLINGS:
        if kinds and kind not in kinds:
            continue
        found = None
        for changes in _gains_for(override_scene(bare, [f"coupling.kind={kind}"]), kind, up_to_s):
            try:
                found = _pressed_with(override_scene(bare, changes), kind, changes, wall, seeds)
            except SceneError:
                continue
            if found.outcome in {"rests", "held"}:
                break
        if found is not None:
            yield found


def _pressed_with(scene: Scene, kind: str, changes: tuple[str, ...], wall: float, seeds: int) -> PressedCoupling:
    """Press a pair with each seed. Stop at the first that does not rest."""
    presses: list[Press] = []
    strokes: list[Stroke] = []
    for seed in range(scene.run.seed, scene.run.seed + seeds):
        pair = override_scene(scene, [f"run.seed={seed}"])
        presses.append(press(pair, wall))
        if presses[-1].outcome in FAILED:
            break
        strokes.append(stroke(pair, wall))
        if strokes[-1].outcome in FAILED:
            break
    return PressedCoupling(kind=kind, changes=changes, presses=tuple(presses), strokes=tuple(strokes))


def without_gains(scene: Scene) -> Scene:
    """Return a scene whose coupling has the default gains of its kind."""
    coupling = scene.coupling and msgspec.structs.replace(scene.coupling, **dict.fromkeys(GAINS))
    return msgspec.structs.replace(scene, coupling=coupling)


def _gains_for(scene: Scene, kind: str, up_to_s: float) -> Iterator[tuple[str, ...]]:
    """Yield overrides that set a coupling with gains for the pair of a scene, the stiffest first."""
    spec, facts, changes = scene_numbers(scene), coupling_facts(kind), (f"coupling.kind={kind}",)
    if facts.stiffness is None:
        yield changes
        return
    if facts.least_damping is not None and not facts.keeps_ledger:
        if (advised := advised_coupling(scene, up_to_s, (kind,))) is not None:
            yield advised.changes
        return
    waves = advised_waves(scene) if kind == "wave" else None
    scale = min(spec["master"]["mass_kg"]) / DEFAULT_MASS_KG
    for share in SHARES:
        felt = min(share, 1.0)
        gains = {
            "stiffness": (share, facts.stiffness),
            "damping": (share, facts.damping),
            "impedance": (felt, facts.impedance),
        }
        numbers = {name: rounded_down(scale * of * value) for name, (of, value) in gains.items() if value}
        if waves is not None:
            if share > 1.0:
                continue
            numbers |= {"stiffness": facts.stiffness, "damping": facts.damping or 0.0, "impedance": share * waves[0]}
        yield *changes, *(f"coupling.{name}={value:g}" for name, value in numbers.items())


def _stable(scene: Scene, up_to_s: float) -> Intervals:
    return coupled_delays([*coupled_loops(scene), *coupled_loops(scene, held=False)], up_to_s)
