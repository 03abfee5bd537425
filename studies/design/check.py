"""Design-time inequalities of a set-up, with the values of a scene."""

from collections.abc import Iterator
from math import ceil, hypot, inf, sqrt
from typing import Any

from haptether.bridge import Scene
from haptether.bridge.scene.research import research_of
from haptether.safety import THROWN_SPEED, EjectionBound, ejection_bound
from haptether.studies.design.contact import rendered, scene_numbers, touched
from haptether.studies.design.couplings import alternative_findings, coupling_advice, coupling_findings
from haptether.studies.design.delay import largest_delay_s, stable_together
from haptether.studies.design.drivers import with_drivers
from haptether.studies.design.finding import (
    MARGIN,
    DesignCheck,
    Finding,
    State,
    Units,
    intervals_text,
    link_delays_s,
    shown_delay_s,
)
from haptether.studies.design.gains import has_halves
from haptether.studies.design.idle import (
    MAX_ONCE_S,
    MAX_RUN_S,
    SETTLED_S,
    SingleEvent,
    idle_link,
    link_with_single_events,
    single_events,
    single_events_on_link,
)
from haptether.studies.design.loops import scene_loops
from haptether.studies.design.remedy import OWN_CONTROLLER, with_remedies
from haptether.studies.design.wall import largest_wall_stiffness

MAX_HOLDS_PER_H = 1.0
MOST_NAMED = 3
"""Largest number of single events of a link, and of their times of hold, that are named."""
PEAK_SPEED, PEAK_ACCELERATION = 1.875, 10.0 / sqrt(3.0)
"""Peaks of a minimum-jerk stroke in units of D/T and D/T² (Flash and Hogan 1985)."""


def check_scene(scene: Scene, *, speed: float | None = None, remedies: bool = True) -> DesignCheck:
    """Check a scene against the design-time inequalities of its loop, observers, limits and link.

    Args:
        scene: Scene of any kind; a rotating device counts by its translation.
        speed: Speed in m/s (rad/s for joints) above which a released device counts as thrown. Default:
            `haptether.safety.THROWN_SPEED`; none for joints, because the speed at the hand depends on its lever.
        remedies: True to search for remedies, which takes most of the time.

    Raises:
        ValueError: The speed is invalid.
        SceneError: The scene is invalid.
    """
    limit = _limit(scene, speed)
    scene, drivers = with_drivers(scene)
    research_of(scene)  # a controller that there is not would have no force

    bounds: dict[str, EjectionBound] = {}

    def judge(changed: Scene, *, link: bool) -> tuple[Finding, ...]:
        spec = scene_numbers(changed)
        settings = changed.ejection_settings()
        # Most changes do not affect the bound, so cache it by its inputs.
        key = repr(settings)
        if key not in bounds:
            bounds[key] = ejection_bound(settings, free_s=inf)
        found = (*_round_trip(changed, spec), *_at_once(changed, spec, limit, bounds[key]))
        return (*found, *_idle(changed, spec)) if link else found

    findings = judge(scene, link=True)
    if remedies:
        findings = with_remedies(scene, findings, judge, limit)
        findings = (*findings, *_advice(scene, findings))
    return DesignCheck(findings=(*drivers, *findings))


def _advice(scene: Scene, findings: tuple[Finding, ...]) -> Iterator[Finding]:
    """Report a coupling that the link bears, unless that is position-force with margin."""
    spec = scene_numbers(scene)
    if spec["slave"] is None:
        return
    lacks_margin = any(one.name == "delay margin" and one.state in {"bad", "warning"} for one in findings)
    if has_halves(spec) or lacks_margin:
        yield from coupling_advice(scene, spec, shown_delay_s(spec))


def check_at_once(scene: Scene, bound: EjectionBound | None = None) -> tuple[Finding, ...]:
    """Return the findings of `check_scene` that need no delay analysis, no link run and no remedy.

    Args:
        scene: Scene of any kind.
        bound: Result of `ejection_bound`; by default computed here.

    Raises:
        SceneError: The scene is invalid.
    """
    return tuple(_at_once(scene, scene_numbers(scene), _limit(scene, None), bound))


def _limit(scene: Scene, speed: float | None) -> float | None:
    """Return the speed in m/s or rad/s above which a release has thrown the device; by default None for joints."""
    unit = Units.of(scene_numbers(scene)).speed
    if speed is None:
        return THROWN_SPEED if unit == "m/s" else None
    if not 0.0 < speed < inf:
        message = (
            f"speed = {speed:g}: must be above 0 and finite: it is the speed in {unit} above which a device"
            " that was let go counts as thrown"
        )
        raise ValueError(message)
    return speed


def _at_once(
    scene: Scene, spec: dict[str, Any], limit: float | None, bound: EjectionBound | None = None
) -> Iterator[Finding]:
    yield from _wall(scene, spec)
    yield from _ejection(scene, spec, limit, bound)
    yield from _vfc(spec, limit)
    yield from _hsc(spec)
    yield from _wsc(spec)
    yield from _grip(spec)
    yield from _holds(spec)


# ------------------------------------------------------------------------------------------------- stability


def _round_trip(scene: Scene, spec: dict[str, Any]) -> Iterator[Finding]:
    """Check the delay margin of contact, and stable intervals beyond it."""
    if spec["slave"] is None:
        return
    if has_halves(spec):
        yield from coupling_findings(scene, spec, shown_delay_s(spec))
        yield from alternative_findings(scene)
        return
    yield from alternative_findings(scene)
    units, beyond = Units.of(spec), "; ".join(touched(scene, spec).beyond)
    loops = scene_loops(scene)
    if not loops or loops[0].environment_stiffness == 0.0:
        if beyond:
            text = f"the loop of one spring does not have what this scene touches: {beyond}"
            yield Finding(name="delay margin", state="not judged", text=text, unit="s")
            return
        yield Finding(name="delay margin", state="note", text="the scene touches nothing, so that nothing oscillates")
        return
    worst = min(loops, key=largest_delay_s)
    delays, up_to_s = link_delays_s(spec), shown_delay_s(spec)
    stable = stable_together(loops, up_to_s)
    who = "held" if worst.hand_stiffness > 0.0 else "nobody holds"
    said = f"contact with {worst.environment_stiffness:g} {units.stiffness}, {who}: {intervals_text(stable, up_to_s)}"
    if delays is None:
        yield Finding(name="delay margin", state="note", text=f"{said}; the link's delays are a recording", unit="s")
    else:
        mean_s, late_s = delays
        margin_s = largest_delay_s(worst)
        state: State = "good" if late_s * MARGIN <= margin_s else "warning"
        if not any(low <= mean_s <= high for low, high in stable):
            state = "bad"
        has = f"{mean_s * 1e3:.0f} ms" if mean_s == late_s else f"{mean_s * 1e3:.0f} ms, 1 in 100 {late_s * 1e3:.0f} ms"
        said = f"{said}; this link has {has}"
        if beyond:
            state, said = "not judged" if state == "good" else state, f"{said}; not in that loop: {beyond}"
        yield Finding(
            name="delay margin", state=state, text=said, value=late_s, limit=margin_s if margin_s < inf else None,
            unit="s",
        )  # fmt: skip
    free = [loop for loop in scene_loops(scene, held=False) if loop.environment_stiffness > 0.0]
    if free and spec["operator"] is not None:
        least_s = min(map(largest_delay_s, free))
        how = "at any delay" if least_s == 0.0 else f"from {least_s * 1e3:.1f} ms on"
        if least_s < inf:
            yield Finding(
                name="let go", state="note", text=f"a device that nobody holds bounces on that contact {how}: what the"
                " controllers are for", value=least_s, unit="s",
            )  # fmt: skip


def _wall(scene: Scene, spec: dict[str, Any]) -> Iterator[Finding]:
    """Check that the rendered stiffness of a servo loop is stable and, as a stronger condition, passive."""
    environment = spec["environment"]
    if spec["slave"] is not None or environment is None or environment["rendering"] != "sampled":
        return
    units, found = Units.of(spec), touched(scene, spec)
    stiffness, wall_damping = found.stiffness, found.damping
    if stiffness == 0.0:
        return
    operator, master, period_s = spec["operator"], spec["master"], spec["run"]["period_s"]
    late, hand = environment["delay_ticks"], operator or {"stiffness": 0.0, "damping": 0.0}

    def largest(mass_kg: float, viscous: float, *, held: bool) -> float:
        return largest_wall_stiffness(
            mass_kg=mass_kg, damping=viscous + (hand["damping"] if held else 0.0), wall_damping=wall_damping,
            hand_stiffness=hand["stiffness"] if held else 0.0, period_s=period_s, late_ticks=late,
        )  # fmt: skip

    axes = list(zip(master["mass_kg"], master["viscous"], strict=True))
    held, free = (min(largest(*axis, held=each) for axis in axes) for each in (True, False))
    damping = min(viscous for _, viscous in axes) + hand["damping"]
    needed = stiffness * period_s * (0.5 + late) + abs(wall_damping)
    state: State = "bad" if stiffness >= held else "warning" if stiffness * MARGIN > held else "good"
    let_go = "at none once it is let go" if free == 0.0 else f"{free:.0f} {units.stiffness} once it is let go"
    late_text = f", {late} ticks late" if late else ""
    yield Finding(
        name="wall", state=state, text=f"{stiffness:g} {units.stiffness} rendered at {1.0 / period_s:.0f}"
        f" Hz{late_text}: stable to {held:.0f} {units.stiffness} while it is held, {let_go} (friction not counted)",
        value=stiffness, limit=held, unit=units.stiffness,
    )  # fmt: skip
    yield Finding(
        name="passive wall", state="good" if damping > needed else "note", text=f"b > K (T/2 + d T) + |B| asks for"
        f" {needed:.2f} {units.damping} of device and hand, which have {damping:.2f}", value=damping, limit=needed,
        unit=units.damping,
    )  # fmt: skip
    quantum, coulomb = master["encoder_quantum"], min(master["coulomb"])
    if quantum > 0.0:
        limit = 2.0 * coulomb / quantum
        yield Finding(
            name="encoder", state="good" if stiffness <= limit else "note", text=f"friction hides the steps of the"
            f" encoder up to K = 2 c / q = {limit:.0f} {units.stiffness} (Abbott and Okamura 2005)", value=stiffness,
            limit=limit, unit=units.stiffness,
        )  # fmt: skip


# ------------------------------------------------------------------------------------------------- observers


def _ejection(
    scene: Scene, spec: dict[str, Any], limit: float | None, bound: EjectionBound | None
) -> Iterator[Finding]:
    """Report the largest speed after a release, and the part that no threshold changes."""
    what = rendered(scene, spec)
    if not what:
        text = "nothing pushes the device, so that nothing can be thrown"
        yield Finding(name="ejection", state="note", text=text)
        return
    if "force" in what and scene.safety.research is not None:
        yield _unknown(scene.safety.research.controller, limit, Units.of(spec).speed)
    elif "force" in what:
        yield _bounded(ejection_bound(scene, free_s=inf) if bound is None else bound, limit, Units.of(spec).speed)
    safety = spec["safety"]
    for part, table, who in (("torque", "rotation", "the handle"), ("trigger", "gripper", "the trigger")):
        if part not in what:
            continue
        own = (safety[table] or {}).get("controllers")
        watched = safety["controllers"] if own is None else own
        text = f"the speed of {who} after a release has no bound"
        if not watched:
            text += ": no controller watches"
        yield Finding(name=f"ejection of {who}", state="not judged" if watched else "bad", text=text)


def _unknown(controller: str, limit: float | None, unit: str) -> Finding:
    """Return the finding for a custom controller, whose force is unknown."""
    text = f"no bound on the speed after a release is known of {controller}, a controller of your own"
    return Finding(
        name="ejection",
        state="not judged",
        text=text,
        limit=limit,
        unit=unit,
        remedy=OWN_CONTROLLER.format(name=controller),
    )


def _bounded(bound: EjectionBound, limit: float | None, unit: str) -> Finding:
    if bound.speed is None:
        return Finding(name="ejection", state="bad", text=bound.text(unit), limit=limit, unit=unit)
    terms = next(of.terms for of in bound.of if of.controller == bound.controller)
    floor = 0.0 if terms is None or terms.threshold_speed is None else terms.floor
    text = bound.text(unit)
    if floor > 0.0:
        text += f"; {floor:.2f} of it are what the estimate of V is late, which no threshold lowers"
    state: State = "good"
    if limit is None:
        state, text = "not judged", f"{text}; what is too fast depends on the lever at the hand"
    elif bound.speed > limit:
        state = "bad"
        text += ": a release cannot be seen in time" if floor > limit else f": above {limit:g} {unit}"
    return Finding(name="ejection", state=state, text=text, value=bound.speed, limit=limit, unit=unit)


def _vfc(spec: dict[str, Any], limit: float | None) -> Iterator[Finding]:
    safety, units = spec["safety"], Units.of(spec)
    if "vfc" not in safety["controllers"] or safety["limiter"] is None:
        return
    cap_n, force_n, least = (
        safety["limiter"]["max_force_n"],
        safety["vfc_force_threshold_n"],
        safety["velocity_threshold"],
    )
    state: State
    if safety["vfc_form"] == "product":
        seen = least * force_n / cap_n
        text = f"VFC sees a push of {cap_n:g} {units.force} from {seen:.2f} {units.speed} on"
        if limit is not None:
            text += f", and at {limit:g} {units.speed} one of {least * force_n / limit:.2g} {units.force}"
    else:
        seen = least
        text = f"VFC sees a push above {force_n:g} {units.force}, of at most {cap_n:g},"
        text += f" at more than {least:g} {units.speed}"
    if safety["vfc_form"] == "both" and force_n >= cap_n:
        state = "bad"
    elif limit is None:
        state = "note"
    else:
        state = "warning" if seen > limit else "good"
    yield Finding(name="vfc", state=state, text=text, value=seen, limit=limit, unit=units.speed)


def _strokes(spec: dict[str, Any]) -> tuple[float, float]:
    """Return the largest speed in m/s and acceleration in m/s² of the hand's path."""
    operator = spec["operator"]
    if operator is None:
        return 0.0, 0.0
    fastest, hardest, start = 0.0, 0.0, operator["start"]
    for leg in operator["legs"]:
        distance_m = hypot(*(end - begin for begin, end in zip(start, leg["end"], strict=True)))
        time_s = leg["duration_s"]
        is_smooth = leg["shape"] == "minimum-jerk"
        if time_s > 0.0:
            fastest = max(fastest, distance_m / time_s * (PEAK_SPEED if is_smooth else 1.0))
            hardest = max(hardest, distance_m / time_s**2 * PEAK_ACCELERATION if is_smooth else 0.0)
        start = leg["end"]
    return fastest, hardest


def _hsc(spec: dict[str, Any]) -> Iterator[Finding]:
    """Check F_t between the need of a moving hand and the pass of the limiter (docs/thresholds.md, Eq. 1)."""
    safety, master, units = spec["safety"], spec["master"], Units.of(spec)
    if "hsc" not in safety["controllers"]:
        return
    force_n, zeta = safety["hsc_force_threshold_n"], safety["grasp_threshold"]
    cap_n = inf if safety["limiter"] is None else safety["limiter"]["max_force_n"]
    if force_n >= cap_n:
        text = (
            f"HSC sees no push below F_t = {force_n:g} {units.force}, and the limiter lets no more than {cap_n:g} pass"
        )
        yield Finding(name="hsc", state="bad", text=text, value=force_n, limit=cap_n, unit=units.force)
        return
    _, hardest = _strokes(spec)
    needed_n = (max(master["mass_kg"]) * hardest + max(master["coulomb"])) / (1.0 - 1.0 / zeta)
    gate = safety["hsc_velocity_threshold"]
    if gate > 0.0:
        text = f"HSC looks at pushes above {force_n:g} {units.force}"
        text += f" that move the device at more than {gate:g} {units.speed}"
        yield Finding(name="hsc", state="good", text=text, value=force_n, unit=units.force)
    else:
        state: State = "good" if force_n >= needed_n else "warning"
        yield Finding(
            name="hsc", state=state, text=f"a hand that moves as this one does needs F_t = (m A + c) / (1 - 1/zeta) ="
            f" {needed_n:.2f} {units.force}, and F_t is {force_n:g}"
            + ("" if state == "good" else ": it trips while it holds"),
            value=force_n, limit=needed_n, unit=units.force,
        )  # fmt: skip


def _wsc(spec: dict[str, Any]) -> Iterator[Finding]:
    """Check the speeds at which WSC trips in free motion (docs/thresholds.md)."""
    safety, master, units = spec["safety"], spec["master"], Units.of(spec)
    if "wsc" not in safety["controllers"] or safety["wsc_force_threshold_n"] > 0.0:
        return
    mass_kg, eta, delta = max(master["mass_kg"]), safety["energy_ratio"], abs(safety["energy_threshold_j"])
    lasting = sqrt(2.0 * eta * delta / mass_kg)
    at_once = sqrt(2.0 * delta / (mass_kg * (1.0 / eta - 1.0))) if eta < 1.0 else inf
    fastest, _ = _strokes(spec)
    window_s = safety["window"] * spec["run"]["period_s"]
    state: State = "good" if fastest <= lasting else "warning"
    text = f"WSC trips in free motion above {at_once:.2f} {units.speed},"
    text += f" and above {lasting:.2f} {units.speed} kept for {window_s * 1e3:.0f} ms"
    text += f"; the fastest stroke of this hand is {fastest:.2f} {units.speed}" if fastest > 0.0 else ""
    yield Finding(name="wsc", state=state, text=text, value=fastest, limit=lasting, unit=units.speed)


def _grip(spec: dict[str, Any]) -> Iterator[Finding]:
    operator, limiter = spec["operator"], spec["safety"]["limiter"]
    if operator is None or limiter is None or operator["grip_strength_n"] is None:
        return
    cap_n, grip_n = limiter["max_force_n"], operator["grip_strength_n"]
    if grip_n < cap_n:
        unit = Units.of(spec).force
        text = f"the limiter lets {cap_n:g} {unit} pass, and this hand slips at {grip_n:g} {unit}"
        yield Finding(name="grip", state="warning", text=text, value=cap_n, limit=grip_n, unit=unit)


# ------------------------------------------------------------------------------------------------- link


def _holds(spec: dict[str, Any]) -> Iterator[Finding]:
    """Check loss bursts longer than the ladder tolerates: runs of at least k lost packets in a two-state chain."""
    if spec["slave"] is None or spec["link"] is None:
        return
    hold_s = spec["safety"]["ladder"]["hold_after_s"]
    periods = {"forward": spec["run"]["period_s"], "backward": spec["slave"]["period_s"]}
    per_h = 0.0
    for name, period_s in periods.items():
        direction = spec["link"][name]
        if not direction or not direction["loss"]:
            continue
        loss = direction["loss"]
        if loss >= 1.0:
            # Reported by the idle link check.
            return
        burst = direction["mean_burst"] or 1.0 / (1.0 - loss)
        packets = ceil(hold_s / period_s)
        stays = 1.0 - 1.0 / burst
        per_h += 3600.0 / period_s * loss / burst * stays ** (packets - 1)
    if per_h == 0.0:
        return
    state: State = "warning" if per_h > MAX_HOLDS_PER_H else "good"
    yield Finding(
        name="losses", state=state, text=f"losses alone silence this link for {hold_s * 1e3:.0f} ms, after which the"
        f" ladder holds, {per_h:.2g} times an hour", value=per_h, limit=MAX_HOLDS_PER_H, unit="1/h",
    )  # fmt: skip


def _idle(scene: Scene, spec: dict[str, Any]) -> Iterator[Finding]:
    """Check how the ladder reacts to this link while nobody moves, whatever the link's impairments."""
    if spec["slave"] is None or scene.link is None:
        return
    idle = idle_link(scene)
    if not idle.engaged:
        yield Finding(name="link", state="bad", text=f"over this link the two never engage: {idle.reason}")
        return
    per_h = idle.holds * 3600.0 / idle.seconds
    rate = f"{per_h:.3g} times an hour" if idle.holds else f"less than {3.0 * 3600.0 / idle.seconds:.3g} times an hour"
    why = f" ({idle.reason})" if idle.reason else ""
    state: State = "bad" if idle.stops else "warning" if idle.holds else "good"
    yield Finding(
        name="link", state=state, text=f"while nobody moves this link makes the ladder hold {rate}{why}, of"
        f" {idle.seconds:g} s that were run", value=per_h, limit=MAX_HOLDS_PER_H, unit="1/h",
    )  # fmt: skip
    yield from _once(scene)


def _once(scene: Scene) -> Iterator[Finding]:
    """Check how the ladder reacts to single events of the link, which have no rate."""
    events = single_events(scene)
    if later := [event for event in events if event.begin_s >= MAX_ONCE_S]:
        yield Finding(
            name="later outage", state="not judged", text=f"once, {_named(later)}: it begins after the"
            f" {MAX_ONCE_S:g} s that are looked at",
        )  # fmt: skip
    once = link_with_single_events(scene)
    if once is None:
        return
    earlier = [event for event in events if event.begin_s < MAX_ONCE_S]
    lasts = max(event.end_s for event in earlier) + SETTLED_S > MAX_RUN_S
    times = ", ".join(f"{at_s:.3g} s" for at_s in once.holds_s[:MOST_NAMED])
    times += ", ..." if once.holds > MOST_NAMED else ""
    count = once.holds + once.stops
    state: State = "warning"
    if once.stops:
        state = "bad"
        holds = f"holds at {times}, and stops" if once.holds else "stops"
        said = f"the ladder {holds} ({once.reason}), and the arm stays stopped until a person acts"
    elif lasts:
        state, said = "not judged", f"it lasts longer than the {MAX_RUN_S:g} s that are run"
    elif not once.coupled:
        state = "bad"
        when = f"the ladder holds at {times}, and the two are" if once.holds else "the two are"
        said = f"{when} not coupled again within {once.seconds:.3g} s ({once.reason})"
    elif once.holds:
        said = f"the ladder holds at {times} ({once.reason}), until the clutch is pressed again"
    else:
        state, said, count = _once_on_link(scene)
    yield Finding(
        name="outage", state=state, text=f"once, {_named(earlier)}: {said}", unit="holds or stops", value=float(count),
    )  # fmt: skip


def _named(events: list[SingleEvent]) -> str:
    more = f" and {len(events) - MOST_NAMED} more" if len(events) > MOST_NAMED else ""
    return f"{', '.join(event.text for event in events[:MOST_NAMED])}{more}"


def _once_on_link(scene: Scene) -> tuple[State, str, int]:
    """Return state, text, holds and stops, over the complete link, of events tolerated with the delay only."""
    both = single_events_on_link(scene)
    assert both is not None, "something happens once"
    found, without = both
    count = found.holds + found.stops
    runs = f"of {found.runs} runs over the whole link"
    if found.stops > without.stops:
        text = f"a side stops in {found.runs} runs over the whole link, and the arm stays stopped until a person acts"
        return "bad", text, count
    if found.uncoupled > without.uncoupled:
        return "bad", f"in {found.uncoupled} {runs} the two are not coupled again", count
    if found.holds > without.holds:
        text = f"over its delay alone the ladder bears it, and holds in {found.held} {runs}"
        return "warning", text + (f", without it in {without.held}" if without.held else ""), count
    if found.holds or found.stops or found.uncoupled:
        text = "over its delay alone the ladder bears it; over the whole link it holds as often without it,"
        text += f" in {found.runs} runs"
        return "not judged", text, count
    return "good", f"the ladder bears it, over its delay alone and in {found.runs} runs over the whole link", 0
