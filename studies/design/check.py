"""Inequalities that a set-up must meet before anything moves, with this scene's numbers."""

from collections.abc import Iterator
from math import ceil, floor, hypot, inf, log10, sqrt
from typing import Any, Literal

from msgspec import Struct

from haptether.bridge import Scene
from haptether.safety import ejection_bound
from haptether.studies.design.delay import ContactLoop, largest_delay_s, stable_delays
from haptether.studies.design.idle import idle_link
from haptether.studies.design.loops import contact_numbers, scene_loops, scene_numbers
from haptether.studies.design.wall import largest_wall_stiffness

Z99 = 2.326
"""Quantile of a normal law that 1 % exceed."""
SHOWN_DELAY_S = 0.5
"""Delays that are looked at, or twice what the link has."""
MARGIN = 1.25
"""Of delay and stiffness, below which a margin is small."""
MAX_HOLDS_PER_H = 1.0
PEAK_SPEED, PEAK_ACCELERATION = 1.875, 10.0 / sqrt(3.0)
"""Of a minimum-jerk stroke, in units of D/T and D/T² (Flash and Hogan 1985)."""

State = Literal["bad", "warning", "good", "note"]


class Finding(Struct, frozen=True, kw_only=True):
    """One inequality with its numbers."""

    name: str
    """What it is about."""
    state: State
    """Whether it holds: bad, warning (little room, or with a price), good, or a note."""
    text: str
    """In one sentence, with numbers and units."""
    value: float | None = None
    limit: float | None = None
    """What `value` is held against, where it is one number."""
    unit: str = ""
    remedy: str | None = None
    """What would mend it."""


class DesignCheck(Struct, frozen=True, kw_only=True):
    """All findings of a scene."""

    findings: tuple[Finding, ...]

    def of(self, state: State) -> tuple[Finding, ...]:
        """The findings in that state."""
        return tuple(finding for finding in self.findings if finding.state == state)


def check_scene(scene: Scene, *, speed: float = 0.5) -> DesignCheck:
    """Holds a scene against the design-time inequalities of its loop, observers, limits and link.

    Args:
        scene: Of any kind; what turns counts by its translation.
        speed: In m/s, above which a device that was let go has been thrown.

    Raises:
        ValueError: A speed that is none.
        SceneError: A scene that cannot be built.
    """
    if not 0.0 < speed < inf:
        message = f"speed = {speed}: must be a number above 0"
        raise ValueError(message)
    spec = scene_numbers(scene)
    parts = (
        _round_trip(scene, spec), _wall(spec), _ejection(scene, speed), _vfc(spec, speed), _hsc(spec), _wsc(spec),
        _grip(spec), _holds(spec), _idle(scene, spec),
    )  # fmt: skip
    return DesignCheck(findings=tuple(finding for part in parts for finding in part))


# ------------------------------------------------------------------------------------------------- stability


def link_delays_s(spec: dict[str, Any]) -> tuple[float, float] | None:
    """Mean of both delays together and what 1 % exceed, in s, ticks included; none where a recording has them."""
    delay_s, variance = 2.0 * max(spec["run"]["period_s"], spec["slave"]["period_s"]), 0.0
    for direction in (spec["link"] or {}).values():
        if direction is None or "delay_s" not in direction:
            continue
        if direction["trace"] is not None:
            return None
        delay_s += direction["delay_s"] or 0.0
        variance += (direction["jitter_s"] or 0.0) ** 2
    return delay_s, delay_s + Z99 * sqrt(variance)


def _round_trip(scene: Scene, spec: dict[str, Any]) -> Iterator[Finding]:
    """Delay margin of contact, and the intervals beyond it."""
    if spec["slave"] is None:
        return
    loops = scene_loops(scene)
    if not loops or loops[0].environment_stiffness == 0.0:
        yield Finding(name="delay margin", state="note", text="the scene touches nothing, so that nothing oscillates")
        return
    worst = min(loops, key=largest_delay_s)
    delays = link_delays_s(spec)
    up_to_s = SHOWN_DELAY_S if delays is None else max(SHOWN_DELAY_S, 2.0 * delays[1])
    stable = stable_delays(worst, up_to_s)
    who = "held" if worst.hand_stiffness > 0.0 else "nobody holds"
    said = f"contact with {worst.environment_stiffness:g} N/m, {who}: {_intervals(stable, up_to_s)}"
    if delays is None:
        yield Finding(name="delay margin", state="note", text=f"{said}; the link's delays are a recording", unit="s")
    else:
        mean_s, late_s = delays
        margin_s = largest_delay_s(worst)
        state: State = "good" if late_s * MARGIN <= margin_s else "warning"
        if not any(low <= mean_s <= high for low, high in stable):
            state = "bad"
        has = f"{mean_s * 1e3:.0f} ms" if mean_s == late_s else f"{mean_s * 1e3:.0f} ms, 1 in 100 {late_s * 1e3:.0f} ms"
        yield Finding(
            name="delay margin", state=state, text=f"{said}; this link has {has}", value=late_s,
            limit=margin_s if margin_s < inf else None, unit="s",
            remedy=None if state == "good" else _softer(worst, late_s),
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


def _intervals(stable: tuple[tuple[float, float], ...], up_to_s: float) -> str:
    if not stable:
        return f"stable at no round trip up to {up_to_s * 1e3:.0f} ms"
    parts = []
    for low, high in stable:
        to = "beyond" if high >= up_to_s else f"{high * 1e3:.1f} ms"
        parts.append(f"to {to}" if low == 0.0 else f"from {low * 1e3:.1f} ms to {to}")
    last = stable[-1][1]
    if stable == ((0.0, up_to_s),):
        return f"stable at every round trip up to {up_to_s * 1e3:.0f} ms"
    rest = "" if last >= up_to_s else ", unstable beyond"
    return f"stable {', again '.join(parts)}{rest}"


def _softer(loop: ContactLoop, delay_s: float) -> str:
    """The force scale at which a delay would be borne, by halving."""
    low, high = 0.0, loop.force_scale
    for _ in range(40):
        middle = 0.5 * (low + high)
        scaled = ContactLoop(**{name: getattr(loop, name) for name in loop.__struct_fields__} | {"force_scale": middle})
        if largest_delay_s(scaled) > delay_s:
            low = middle
        else:
            high = middle
    if low < 1e-6:
        return "no coupling.force_scale bears it: a softer contact, more damping, less delay"
    digits = 1 - floor(log10(low))
    # Rounded down: what is printed bears it.
    scale = floor(low * 10.0**digits) / 10.0**digits
    return f"coupling.force_scale of {scale:g} bears it, or a softer contact, more damping, less delay"


def _wall(spec: dict[str, Any]) -> Iterator[Finding]:
    """Stiffness that a servo loop renders: stable and, more than that, passive."""
    environment = spec["environment"]
    if spec["slave"] is not None or environment is None or environment["rendering"] != "sampled":
        return
    limiter = spec["safety"]["limiter"]
    stiffness, wall_damping = contact_numbers(environment, inf if limiter is None else limiter["max_force_n"])
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
    let_go = "at none once it is let go" if free == 0.0 else f"{free:.0f} N/m once it is let go"
    late_text = f", {late} ticks late" if late else ""
    yield Finding(
        name="wall", state=state, text=f"{stiffness:g} N/m rendered at {1.0 / period_s:.0f} Hz{late_text}: stable to"
        f" {held:.0f} N/m while it is held, {let_go} (friction not counted)", value=stiffness, limit=held, unit="N/m",
        remedy=None if state == "good" else "a softer wall, a shorter run.period_s, less delay or more damping",
    )  # fmt: skip
    yield Finding(
        name="passive wall", state="good" if damping > needed else "note", text=f"b > K (T/2 + d T) + |B| asks for"
        f" {needed:.2f} N s/m of device and hand, which have {damping:.2f}", value=damping, limit=needed, unit="N s/m",
    )  # fmt: skip
    quantum, coulomb = master["encoder_quantum"], min(master["coulomb"])
    if quantum > 0.0:
        limit = 2.0 * coulomb / quantum
        yield Finding(
            name="encoder", state="good" if stiffness <= limit else "note", text=f"friction hides the steps of the"
            f" encoder up to K = 2 c / q = {limit:.0f} N/m (Abbott and Okamura 2005)", value=stiffness, limit=limit,
            unit="N/m",
        )  # fmt: skip


# ------------------------------------------------------------------------------------------------- observers


def _ejection(scene: Scene, speed: float) -> Iterator[Finding]:
    """What a device may reach once it is let go, and what of that no threshold changes."""
    bound = ejection_bound(scene)
    state: State
    if bound.speed is None:
        state = "bad" if bound.reason is not None and "watches" in bound.reason else "warning"
        yield Finding(name="ejection", state=state, text=bound.text(), limit=speed, unit="m/s",
                      remedy='safety.controllers=["wsc"], or with stops also "hsc"')  # fmt: skip
        return
    terms = next(of.terms for of in bound.of if of.controller == bound.controller)
    floor = 0.0 if terms is None or terms.threshold_speed is None else terms.floor
    text = f"{bound.text()}; {floor:.2f} of it are what the estimate of V is late, which no threshold lowers"
    if floor == 0.0:
        text = bound.text()
    state, remedy = "good", None
    if bound.speed > speed:
        state = "bad" if floor > speed else "warning"
        text += ": a release cannot be seen in time" if floor > speed else f": above {speed:g} m/s"
        quicker = "" if scene.safety.estimator.__struct_config__.tag == "dual-kalman" else "dual-kalman, "
        remedy = f"{quicker}a device that measures V, or a lower safety.limiter.max_force_n"
        remedy += "" if floor > speed else " or |safety.energy_threshold_j|"
    yield Finding(
        name="ejection", state=state, text=text, value=bound.speed, limit=speed, unit="m/s", remedy=remedy
    )  # fmt: skip


def _vfc(spec: dict[str, Any], speed: float) -> Iterator[Finding]:
    safety = spec["safety"]
    if "vfc" not in safety["controllers"] or safety["limiter"] is None:
        return
    cap_n, force_n = safety["limiter"]["max_force_n"], safety["vfc_force_threshold_n"]
    seen = safety["velocity_threshold"] * force_n / cap_n if safety["vfc_form"] == "product" else None
    if seen is None:
        least = safety["velocity_threshold"]
        state: State = "bad" if force_n >= cap_n else "warning" if least > speed else "good"
        text = f"VFC sees a push above {force_n:g} N, of at most {cap_n:g}, at more than {least:g} m/s"
        remedy = None if state == "good" else "a lower velocity_threshold or vfc_force_threshold_n"
        yield Finding(name="vfc", state=state, text=text, value=least, limit=speed, unit="m/s", remedy=remedy)
        return
    state = "warning" if seen > speed else "good"
    weakest = safety["velocity_threshold"] * force_n / speed
    yield Finding(
        name="vfc", state=state, text=f"VFC sees a push of {cap_n:g} N from {seen:.2f} m/s on, and at {speed:g} m/s one"
        f" of {weakest:.2g} N", value=seen, limit=speed, unit="m/s",
        remedy=None if state == "good" else "a lower velocity_threshold or vfc_force_threshold_n",
    )  # fmt: skip


def _strokes(spec: dict[str, Any]) -> tuple[float, float]:
    """Largest speed in m/s and acceleration in m/s² of the hand's path."""
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
    """F_t between what a hand that moves needs and what the limiter lets pass (docs/thresholds.md, Eq. 1)."""
    safety, master = spec["safety"], spec["master"]
    if "hsc" not in safety["controllers"]:
        return
    force_n, zeta = safety["hsc_force_threshold_n"], safety["grasp_threshold"]
    cap_n = inf if safety["limiter"] is None else safety["limiter"]["max_force_n"]
    if force_n >= cap_n:
        text = f"HSC sees no push below F_t = {force_n:g} N, and the limiter lets no more than {cap_n:g} N pass"
        yield Finding(name="hsc", state="bad", text=text, value=force_n, limit=cap_n, unit="N",
                      remedy="a lower hsc_force_threshold_n")  # fmt: skip
        return
    _, hardest = _strokes(spec)
    needed_n = (max(master["mass_kg"]) * hardest + max(master["coulomb"])) / (1.0 - 1.0 / zeta)
    gate = safety["hsc_velocity_threshold"]
    if gate > 0.0:
        text = f"HSC looks at pushes above {force_n:g} N that move the device at more than {gate:g} m/s"
        yield Finding(name="hsc", state="good", text=text, value=force_n, unit="N")
    else:
        state: State = "good" if force_n >= needed_n else "warning"
        yield Finding(
            name="hsc", state=state, text=f"a hand that moves as this one does needs F_t = (m A + c) / (1 - 1/zeta) ="
            f" {needed_n:.2f} N, and F_t is {force_n:g} N" + ("" if state == "good" else ": it trips while it holds"),
            value=force_n, limit=needed_n, unit="N",
            remedy=None if state == "good" else "hsc_velocity_threshold of 0.05 m/s, or that F_t",
        )  # fmt: skip


def _wsc(spec: dict[str, Any]) -> Iterator[Finding]:
    """Speeds at which WSC trips in free motion (docs/thresholds.md)."""
    safety, master = spec["safety"], spec["master"]
    if "wsc" not in safety["controllers"] or safety["wsc_force_threshold_n"] > 0.0:
        return
    mass_kg, eta, delta = max(master["mass_kg"]), safety["energy_ratio"], abs(safety["energy_threshold_j"])
    lasting = sqrt(2.0 * eta * delta / mass_kg)
    at_once = sqrt(2.0 * delta / (mass_kg * (1.0 / eta - 1.0))) if eta < 1.0 else inf
    fastest, _ = _strokes(spec)
    window_s = safety["window"] * spec["run"]["period_s"]
    state: State = "good" if fastest <= lasting else "warning"
    text = f"WSC trips in free motion above {at_once:.2f} m/s,"
    text += f" and above {lasting:.2f} m/s kept for {window_s * 1e3:.0f} ms"
    text += f"; the fastest stroke of this hand is {fastest:.2f} m/s" if fastest > 0.0 else ""
    remedy = None if state == "good" else "wsc_force_threshold_n of 0.1 N, or a larger |energy_threshold_j|"
    yield Finding(name="wsc", state=state, text=text, value=fastest, limit=lasting, unit="m/s", remedy=remedy)


def _grip(spec: dict[str, Any]) -> Iterator[Finding]:
    operator, limiter = spec["operator"], spec["safety"]["limiter"]
    if operator is None or limiter is None or operator["grip_strength_n"] is None:
        return
    cap_n, grip_n = limiter["max_force_n"], operator["grip_strength_n"]
    if grip_n < cap_n:
        yield Finding(name="grip", state="warning", text=f"the limiter lets {cap_n:g} N pass, and this hand slips at"
                      f" {grip_n:g} N", value=cap_n, limit=grip_n, unit="N",
                      remedy=f"safety.limiter.max_force_n of {grip_n:g} N")  # fmt: skip


# ------------------------------------------------------------------------------------------------- link


def _holds(spec: dict[str, Any]) -> Iterator[Finding]:
    """Bursts of losses that the ladder does not bear: runs of at least k lost packets, of a chain of two states."""
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
            # The idle link says so.
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
        remedy=None if state == "good" else "a longer safety.ladder.hold_after_s, or a better link",
    )  # fmt: skip


def _idle(scene: Scene, spec: dict[str, Any]) -> Iterator[Finding]:
    """What the ladder makes of this link while nobody moves, whatever the link is made of."""
    if spec["slave"] is None or scene.link is None:
        return
    idle = idle_link(scene)
    if not idle.engaged:
        yield Finding(
            name="link", state="bad", text=f"over this link the two never engage: {idle.reason}",
            remedy="is delay_s in seconds? 0.05 is 50 ms; else less delay and loss",
        )  # fmt: skip
        return
    per_h = idle.holds * 3600.0 / idle.seconds
    rate = f"{per_h:.3g} times an hour" if idle.holds else f"less than {3.0 * 3600.0 / idle.seconds:.3g} times an hour"
    why = f" ({idle.reason})" if idle.reason else ""
    state: State = "bad" if idle.stops else "warning" if idle.holds else "good"
    yield Finding(
        name="link", state=state, text=f"while nobody moves this link makes the ladder hold {rate}{why}, of"
        f" {idle.seconds:g} s that were run", value=per_h, limit=MAX_HOLDS_PER_H, unit="1/h",
        remedy=None if state == "good" else "less jitter and loss, or a longer safety.ladder.hold_after_s",
    )  # fmt: skip
