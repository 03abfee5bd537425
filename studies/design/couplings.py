"""Findings of couplings with two halves, and the coupling that a device pair and its round trip allow."""

from collections.abc import Iterator
from math import inf
from typing import Any

import msgspec

from haptether.bridge import Scene, coupling_facts, override_scene
from haptether.studies.design.contact import contacts, scene_numbers, touched
from haptether.studies.design.coupled import coupled_delays, coupled_loops
from haptether.studies.design.delay import largest_delay_s, stable_together
from haptether.studies.design.finding import (
    MARGIN,
    Finding,
    Intervals,
    State,
    Units,
    intervals_text,
    link_delays_s,
    rounded_down,
    rounded_up,
)
from haptether.studies.design.gains import (
    DAMPING_MARGIN,
    advised_coupling,
    advised_waves,
    facts_of,
    has_halves,
    held_damping,
    least_damping_of,
    pressed_couplings,
    softer_gains,
    stated_gains,
)
from haptether.studies.design.loops import scene_loops
from haptether.studies.design.press import FAILED, press, stroke

STIFFER = 1.2
"""Least ratio of the stiffness of waves to that of the advised coupling, for which they are named too."""
PRESSED_S = 0.004
"""Shortest round trip in s that is pressed to find the largest stable one."""
PRESSED_STEP = 1.5
"""Ratio of two round trips that are pressed."""
FELT = 0.2
"""Share of the force of a rigid tool below which a press is too soft."""


def bearable_delays(scene: Scene, up_to_s: float, wall_stiffness: float | None = None) -> tuple[float, Intervals]:
    """Return the smallest sum of both delays in s at which a scene's loop oscillates, and the stable intervals.

    A coupling that no linear loop describes is pressed; the first result is then the largest delay that still rests.

    Args:
        scene: Scene with a [slave], of any coupling.
        up_to_s: Largest delay in s that is examined; without oscillation up to it the first result is infinite.
        wall_stiffness: Stiffness in N/m that replaces the scene's contact.
    """
    spec = scene_numbers(scene)
    if has_halves(spec):
        facts = facts_of(spec)
        if facts.keeps_ledger:
            return inf, ((0.0, up_to_s),)
        if facts.master is None:
            return _pressed_delays(scene, up_to_s, wall_stiffness)
        stable = coupled_delays(coupled_loops(scene, wall_stiffness), up_to_s)
        return _margin_s(stable, up_to_s), stable
    loops = scene_loops(scene, wall_stiffness)
    return min(map(largest_delay_s, loops)), stable_together(loops, up_to_s)


def _pressed_delays(scene: Scene, up_to_s: float, wall: float | None) -> tuple[float, Intervals]:
    """Return the largest delay up to which presses rest, and the intervals of those that rest, of the tried delays.

    A delay over which the ladder holds says nothing.
    """
    wall = touched(scene, scene_numbers(scene)).stiffness if wall is None else wall
    found: list[tuple[float, float]] = []
    margin_s, is_stable, delay_s = 0.0, True, PRESSED_S
    while True:
        at_s = min(delay_s, up_to_s)
        ways = [
            f"link.{way}.{key}" for way in ("forward", "backward") for key in (f"delay_s={at_s / 2.0!r}", "jitter_s=0")
        ]
        outcome = press(override_scene(scene, ways), wall).outcome
        if outcome == "rests" and is_stable:
            found = [*found[:-1], (found[-1][0], at_s)] if found else [(0.0, at_s)]
        elif outcome == "rests":
            found.append((at_s, at_s))
        if outcome != "held":
            is_stable = outcome == "rests"
        if is_stable and len(found) == 1:
            margin_s = found[0][1]
        if at_s == up_to_s:
            break
        delay_s *= PRESSED_STEP
    return inf if margin_s == up_to_s else margin_s, tuple(found)


def _margin_s(stable: Intervals, up_to_s: float) -> float:
    """Return the end of the interval that begins at 0; infinite if that is the largest examined delay."""
    first_s = stable[0][1] if stable and stable[0][0] == 0.0 else 0.0
    return inf if first_s >= up_to_s else first_s


def coupling_findings(scene: Scene, spec: dict[str, Any], up_to_s: float) -> Iterator[Finding]:
    """Check delay margin, passivity and felt stiffness of a coupling with two halves."""
    coupling, units, delays = spec["coupling"], Units.of(spec), link_delays_s(spec)
    if spec["master"]["kind"] == "pose":
        yield _pressed(scene, spec, units)
        text = f"{coupling['kind']} of a pose: of its rotation nothing is judged; simulate the scene"
        yield Finding(name="coupling", state="not judged", text=text)
        return
    facts = facts_of(spec)
    if facts.master is None:
        yield _ledger(spec, units) if facts.keeps_ledger else _unclaimed(coupling["kind"])
        yield _pressed(scene, spec, units)
        if coupling["kind"] == "wave" and coupling["command_reach"] is None:
            yield Finding(
                name="reach", state="warning", text="waves have no spring to the hand: a push moves the arm without"
                " limit while the device is let go: set coupling.command_reach",
            )  # fmt: skip
        yield from _felt(scene, spec, units, delays)
        yield from _push(spec)
        return
    kind, beyond = coupling["kind"], "; ".join(touched(scene, spec).beyond)
    loops = coupled_loops(scene)
    stable = coupled_delays(loops, up_to_s)
    margin_s = _margin_s(stable, up_to_s)
    walls = ", ".join(f"{stiffness:g}" for stiffness in sorted({loop.environment_stiffness for loop in loops} - {0.0}))
    touches = f" and on {walls} {units.stiffness}" if walls else ""
    text = f"{kind}, {_who(spec)}, in free motion{touches}: {intervals_text(stable, up_to_s)}"
    state: State = "note"
    if delays is None:
        text += "; the link's delays are a recording"
    else:
        mean_s, late_s = delays
        state = "good" if late_s * MARGIN <= margin_s else "warning"
        if not any(low <= mean_s <= high for low, high in stable):
            state = "bad"
        text += f"; this link has {mean_s * 1e3:.0f} ms, 1 in 100 {late_s * 1e3:.0f} ms"
    if beyond:
        state, text = "not judged" if state == "good" else state, f"{text}; not in that loop: {beyond}"
    yield Finding(
        name="delay margin", state=state, text=text, value=delays and delays[1], unit="s",
        limit=None if margin_s == inf else margin_s,
    )  # fmt: skip
    if spec["operator"] is not None:
        free = coupled_delays(coupled_loops(scene, held=False), up_to_s)
        if (least_s := _margin_s(free, up_to_s)) < inf:
            text = f"a device that nobody holds is {intervals_text(free, up_to_s)}"
            yield Finding(name="let go", state="note", text=text, value=least_s, unit="s")
    yield from _passive(spec, units, delays)
    yield from _felt(scene, spec, units, delays)
    yield from _push(spec)


def _unclaimed(kind: str) -> Finding:
    text = f"{kind} claims none: the press below is of this hand, device, arm, wall and link"
    return Finding(name="passivity", state="note", text=text)


def alternative_findings(scene: Scene) -> Iterator[Finding]:
    """Press the pair under each coupling to which an operator may switch."""
    coupling = scene.coupling
    if coupling is None:
        return
    for other in coupling.alternatives:
        numbers = {name: getattr(other, name) for name in other.__struct_fields__}
        changes = tuple(
            msgspec.structs.replace(change, kind=None) for change in coupling.changes if change.kind is None
        )
        switched = msgspec.structs.replace(coupling, **numbers, alternatives=(), changes=changes)
        alone = msgspec.structs.replace(scene, coupling=switched)
        spec = scene_numbers(alone)
        found = _pressed(alone, spec, Units.of(spec))
        yield msgspec.structs.replace(found, name=f"contact, {other.kind}", value=None)


def _push(spec: dict[str, Any]) -> Iterator[Finding]:
    """Report that HSC claims no bound where the push may grow."""
    kind = spec["coupling"]["kind"]
    if coupling_facts(kind).push_may_grow and "hsc" in spec["safety"]["controllers"]:
        yield Finding(
            name="push", state="note", text=f"with {kind} the push may grow after a release, as the spring pulls to"
            " where the arm still is: the bound of HSC does not hold, that of WSC does",
        )  # fmt: skip


def _who(spec: dict[str, Any]) -> str:
    return "nobody holds" if spec["operator"] is None else "held"


def _ledger(spec: dict[str, Any], units: Units) -> Finding:
    """Check the damper of a coupling that counts its energy: it must outweigh the sampled spring."""
    kind, (stiffness, damping) = spec["coupling"]["kind"], stated_gains(spec)
    least = least_damping_of(kind, stiffness, 0.0, spec)
    assert least is not None
    claim = (
        f"{kind} counts its energy: delay, jitter and loss create none at the virtual tool; the press has the arm's lag"
    )
    if kind == "tdpa":
        claim += ", but for a deficit that the master takes back with a bounded damping"
    return Finding(
        name="passivity", state="good" if damping > least else "warning", text=f"{claim}; the sampled spring of"
        f" {stiffness:g} {units.stiffness} needs B above {least:.3g} {units.damping}, it has {damping:g}",
        value=least, limit=damping, unit=units.damping,
    )  # fmt: skip


def _pressed(scene: Scene, spec: dict[str, Any], units: Units) -> Finding:
    """Press the pair on its stiffest wall over the link, for a coupling that no linear loop describes."""
    kind, wall = spec["coupling"]["kind"], touched(scene, spec).stiffness
    seen = press(scene, wall)
    length = "mrad" if units.stiffness == "N m/rad" else "mm"
    on = f" on {wall:g} {units.stiffness}" if wall else " on a wall"
    text = f"pressed{on} in virtual time, as a rigid tool with {seen.rigid:.2g} {units.force}, {kind}"
    off = {"swings": 2.0 + seen.swing / seen.rigid, "saturated": 2.0 + seen.felt}.get(seen.outcome, 1.0 - seen.felt)
    held = f"{seen.felt * 100.0:.0f} % of that force"
    behind = f"; the arm is {seen.behind * 1e3:.2g} {length} behind"
    match seen.outcome:
        case "held":
            return Finding(
                name="contact", state="not judged", text=f"{text} is interrupted by the ladder over this link"
            )
        case "diverged":
            return Finding(
                name="contact", state="bad", text=f"{text} diverges: gains, delay, lag of the arm and noise count"
            )
        case "swings":
            text += f" swings at {held}, peak to peak {seen.swing:.2g} {units.force}{behind}"
        case "saturated":
            text += f" is at the cap or at a stop, with {held}{behind}"
        case "slack":
            text += f" does not reach the wall: it holds {held}{behind}"
        case _:
            text += f" rests at {held}{behind}"
            if stroke(scene, wall).outcome in FAILED:
                text, off = f"{text}; it swings without contact", 2.0
            elif seen.felt >= FELT:
                return Finding(name="contact", state="good", text=text)
    return Finding(name="contact", state="warning", text=text, value=off)


def _passive(spec: dict[str, Any], units: Units, delays: tuple[float, float] | None) -> Iterator[Finding]:
    """Check that the damping makes the coupling passive at the longest delay of the link."""
    kind, (stiffness, damping) = spec["coupling"]["kind"], stated_gains(spec)
    least = None if delays is None else least_damping_of(kind, stiffness, delays[1], spec)
    if delays is None or least is None:
        why = f"{kind} claims none" if delays is not None else "the link's delays are a recording"
        yield Finding(name="passivity", state="note", text=f"{why}: the stable delays above are of this hand and wall")
        return
    state: State = "good" if damping > least else "warning"
    yield Finding(
        name="passivity", state=state, text=f"{kind} with K = {stiffness:g} {units.stiffness} is passive over"
        f" {delays[1] * 1e3:.0f} ms, for any hand and tool, from B = {least:.3g} {units.damping} on; it has"
        f" {damping:g}",
        value=least, limit=damping, unit=units.damping,
    )  # fmt: skip


def _felt(scene: Scene, spec: dict[str, Any], units: Units, delays: tuple[float, float] | None) -> Iterator[Finding]:
    """Report the stiffness that the hand feels and how far the arm stays behind at rest, for each contact."""
    compliance = facts_of(spec, delays[0] if delays else 0.0).compliance
    assert compliance is not None
    arm = scene_loops(scene, 0.0)[0].follower if scene_loops(scene, 0.0) else None
    springs, walls = contacts(spec)
    found = sorted({contact for contact, _ in (*springs, *walls) if contact > 0.0})
    takes_force = spec["slave"]["takes_force"]
    if arm is None or not found or (arm.stiffness == 0.0 and not takes_force):
        return
    behind = compliance + (0.0 if takes_force else 1.0 / arm.stiffness)
    shares = [1.0 / (1.0 + contact * behind) for contact in found]
    each = ", ".join(f"{share:.2g} of {contact:g}" for share, contact in zip(shares, found, strict=True))
    length = "mrad" if units.stiffness == "N m/rad" else "mm"
    series, more = "1/K", "; a stiffer coupling.stiffness feels more"
    if _is_wave(spec):
        series, more = "C, without the waits of the play-out,", "; a larger coupling.impedance feels more"
    elif compliance == 0.0:
        series, more = "C = 0", ""
    if not takes_force:
        series += " + 1/K_arm"
    yield Finding(
        name="felt stiffness", state="note", value=min(shares), text=f"at rest{_delay(spec, delays)} the hand feels"
        f" {each} {units.stiffness} ({series} in series), and the arm stays {behind * 1e3:.3g} {length}"
        f" behind per {units.force}{more}",
    )  # fmt: skip


def _is_wave(spec: dict[str, Any]) -> bool:
    return facts_of(spec, 1.0).compliance != facts_of(spec, 0.0).compliance


def _delay(spec: dict[str, Any], delays: tuple[float, float] | None) -> str:
    """Return the delay for which a compliance holds."""
    if not _is_wave(spec):
        return ", at any delay,"
    return f", at a round trip of {delays[0] * 1e3 if delays else 0.0:.0f} ms,"


def coupling_advice(scene: Scene, spec: dict[str, Any], up_to_s: float) -> Iterator[Finding]:
    """Report the coupling that a device pair and its round trip allow, with the lines of its table."""
    advised, delays, units = advised_coupling(scene, up_to_s), link_delays_s(spec), Units.of(spec)
    waves = advised_waves(scene)
    if advised is None or delays is None:
        return
    if waves is not None and waves[1] > STIFFER * advised.stiffness:
        yield Finding(
            name="waves", state="note", text=f"over {delays[0] * 1e3:.0f} ms waves are stiffer at rest:"
            f" {waves[1]:.3g} {units.stiffness} instead of {advised.stiffness:g}, less what the play-out waits:"
            f" [coupling] kind = \"wave\", impedance = {waves[0]:g}",
            value=waves[1], unit=units.stiffness,
        )  # fmt: skip
    pressed = [*pressed_couplings(scene, up_to_s)]
    ranked = sorted((one for one in pressed if one.outcome == "rests"), key=lambda one: -one.press.felt)
    if ranked:
        each = ", ".join(f"{one.kind} {one.press.felt * 100.0:.0f} %" for one in ranked)
        others = [f"{one.kind} {one.outcome}" for one in pressed if one.outcome != "rests"]
        yield Finding(
            name="couplings", state="note", text=f"pressed over this link, each with gains for this pair, as a share of"
            f" the force of a rigid tool: {', '.join((each, *others))}",
        )  # fmt: skip
    yield Finding(
        name="coupling", state="note", text=f"over {delays[1] * 1e3:.0f} ms this pair bears {advised.kind} with K ="
        f" {advised.stiffness:g} {units.stiffness}, passive for any hand and tool; held"
        f" or let go it is {intervals_text(advised.stable, up_to_s)}: [coupling] kind = \"{advised.kind}\", stiffness ="
        f" {advised.stiffness:g}, damping = {advised.damping:g}",
        value=advised.stiffness, unit=units.stiffness,
    )  # fmt: skip


def other_gains(scene: Scene, spec: dict[str, Any], up_to_s: float) -> Iterator[tuple[str, ...]]:
    """Yield changes of a coupling's gains, the mildest first, then the advised coupling."""
    kind, (stiffness, damping), delays = spec["coupling"]["kind"], stated_gains(spec), link_delays_s(spec)
    if facts_of(spec).master is None:
        yield from softer_gains(spec, stiffness, damping)
    least = None if delays is None else least_damping_of(kind, stiffness, delays[1], spec)
    if least is not None and damping < DAMPING_MARGIN * least < held_damping(spec):
        yield (f"coupling.damping={rounded_up(DAMPING_MARGIN * least):g}",)
    if least is None:
        for share in (0.5, 0.25, 0.1):
            softer, weaker = rounded_down(share * stiffness), rounded_down(share**0.5 * damping) if damping else 0.0
            yield f"coupling.stiffness={softer:g}", f"coupling.damping={weaker:g}"
    if (same := advised_coupling(scene, up_to_s, (kind,))) is not None:
        yield same.changes[1:]
    if (other := advised_coupling(scene, up_to_s)) is not None:
        yield other.changes
