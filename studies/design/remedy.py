"""Remedies of findings: field changes that were applied and checked again."""

from collections.abc import Iterator
from math import inf, isfinite, sqrt
from typing import Any, Literal, Protocol

from msgspec.structs import replace

from haptether.bridge import Scene, SceneError, override_scene
from haptether.bridge.scene.resolve import DEFAULT_DAMPING, max_damping, side_kind
from haptether.safety import ejection_bound
from haptether.studies.design.contact import scene_numbers
from haptether.studies.design.couplings import other_gains
from haptether.studies.design.delay import ContactLoop, largest_delay_s
from haptether.studies.design.finding import (
    MARGIN,
    Finding,
    State,
    link_delays_s,
    rounded_down,
    rounded_up,
    shown_delay_s,
)
from haptether.studies.design.gains import has_halves
from haptether.studies.design.idle import MAX_ONCE_S, EventKind, single_events
from haptether.studies.design.loops import scene_loops

Changes = tuple[str, ...]
RANKS: dict[State, int] = {"bad": 0, "warning": 1, "not judged": 2, "good": 3, "note": 3}
"""Rank of each state; larger is better."""
HOLDS_AFTER_S = (0.03, 0.05, 0.1)
"""Tried hold times of a ladder in s; the last is the longest allowed."""
HALVINGS = 40
SECANTS = 4
"""Iterations of the search for cap or threshold: the speed bound is nearly linear in their root."""
LEAST_ENERGY_J = 0.003
"""A tenth of the paper's |delta|; below it WSC trips in almost any motion."""
LEAST_SHARE_OF_CAP = 0.5
"""Smallest fraction of the cap; below it little is felt."""

ADVICE = {
    "delay margin": "a softer contact, more damping, less delay",
    "passivity": "less delay and jitter, or a lower coupling.stiffness",
    "contact": "other gains, or another coupling (docs/choosing-a-coupling.md)",
    "wall": "a softer wall, a shorter run.period_s, less delay or more damping",
    "ejection": "a device that measures V",
    "ejection of the handle": "a controller that watches",
    "ejection of the trigger": "a controller that watches",
    "vfc": "a lower safety.velocity_threshold or safety.vfc_force_threshold_n",
    "hsc": "an F_t (safety.hsc_force_threshold_n) between what the hand needs and what the limiter lets pass",
    "wsc": "slower strokes; or the device's master.stops: F_w lets free motion pass, and a bound remains",
    "grip": "a firmer grip, or a lower safety.limiter.max_force_n",
    "losses": "a better link",
    "link": "less delay, jitter and loss; a delay_s is in seconds: 0.05 is 50 ms",
}
"""Further advice by subject of a finding; not all of it is a field."""
ONCE_ADVICE: dict[EventKind, str] = {
    "outage": "a shorter outage: safety.ladder.hold_after_s bears at most 0.1 s, and what is longer ends in HOLD",
    "delay": "a smaller change of the delay, or a slower one (ramp_s)",
    "clock": "a clock that is not set while the two are coupled",
}
"""Advice against single events of a link, by kind."""
OWN_CONTROLLER = (
    "measure it: `haptether falsify` on this scene finds the release after which it is worst, `haptether evaluate"
    " --controller none {name}` how often it throws and trips falsely"
)
"""Advice if no bound is known."""


class Judge(Protocol):
    """Check of a scene against all inequalities."""

    def __call__(self, scene: Scene, /, *, link: bool) -> tuple[Finding, ...]:
        """Return the findings, with or without those of the idle link."""


def with_remedies(
    scene: Scene, findings: tuple[Finding, ...], judge: Judge, limit: float | None
) -> tuple[Finding, ...]:
    """Add remedies to the findings that are bad or a warning.

    Takes the first tried changes that remove the finding, otherwise those that improve it most, without unnecessary
    ones. Changes count only if the finding improves or disappears, and no other becomes worse.

    Args:
        scene: Checked scene.
        findings: Findings of the scene.
        judge: Check that produced them.
        limit: Speed in m/s or rad/s above which a release has thrown the device; None without such a limit.
    """
    return tuple(
        _mended(scene, finding, findings, judge, limit) if finding.state in {"bad", "warning"} else finding
        for finding in findings
    )


def is_better(after: Finding | None, before: Finding) -> bool:
    """Return True if a finding is gone, in a better state, or in the same state with a larger margin."""
    if after is None:
        return True
    rank, old = RANKS[after.state], RANKS[before.state]
    return rank > old or (rank == old and _excess(after) < _excess(before))


def is_worse(after: Finding, before: Finding | None) -> bool:
    """Return True if a finding is in a worse state; a new one is worse if it is bad or a warning."""
    old = RANKS["good"] if before is None else RANKS[before.state]
    return RANKS[after.state] < min(old, RANKS["not judged"]) or (
        before is not None
        and RANKS[after.state] == old < RANKS["not judged"]
        and _excess(after) > _excess(before) * (1.0 + 1e-9)
    )


def _excess(finding: Finding) -> float:
    """Return value divided by limit; infinite without a value."""
    if finding.value is None:
        return inf
    return finding.value / finding.limit if finding.limit else finding.value


def _mended(
    scene: Scene, finding: Finding, findings: tuple[Finding, ...], judge: Judge, limit: float | None
) -> Finding:
    before = {one.name: one for one in findings}
    on_link = finding.name in {"link", "outage"}

    def tried(changes: Changes) -> Finding | bool | None:
        """Return the finding with these changes, or None if gone; False if the changes are invalid or do not help."""
        try:
            found = {one.name: one for one in judge(override_scene(scene, changes), link=on_link)}
        except SceneError:
            return False
        after = found.get(finding.name)
        if not is_better(after, finding) or any(
            is_worse(one, before.get(name)) for name, one in found.items() if name != finding.name
        ):
            return False
        return after

    best: tuple[Changes, Finding | None] | None = None
    for changes in _candidates(scene, finding, limit):
        after = tried(changes)
        if isinstance(after, bool):
            continue
        if best is None or best[1] is None or is_better(after, best[1]):
            best = changes, after
        if _is_mended(after):
            break
    advice = _once_advice(scene) if finding.name == "outage" else ADVICE.get(finding.name)
    if best is None:
        return replace(finding, remedy=advice)
    changes, after = best
    for change in changes if len(changes) > 1 else ():
        fewer = tuple(one for one in changes if one != change)
        if not fewer:
            break
        now = tried(fewer)
        as_good = not isinstance(now, bool) and (now is None or (after is not None and not is_better(after, now)))
        if not isinstance(now, bool) and as_good:
            changes, after = fewer, now
    remedy = f"{', '.join(changes)}: {_outcome(after)}"
    if not _is_mended(after) and advice is not None:
        remedy += f"; besides {advice}"
    if any(one.startswith("safety.ladder.hold_after_s=") for one in changes):
        remedy += "; both sides then hold that much later"
    if finding.name == "ejection" and any(one.startswith("safety.energy_threshold_j=") for one in changes):
        remedy += "; WSC then trips sooner while a hand holds, too (docs/thresholds.md)"
    return replace(finding, remedy=remedy, changes=changes)


def _once_advice(scene: Scene) -> str:
    kinds = dict.fromkeys(event.kind for event in single_events(scene) if event.begin_s < MAX_ONCE_S)
    return "; ".join(ONCE_ADVICE[kind] for kind in kinds)


def _is_mended(after: Finding | None) -> bool:
    return after is None or after.state in {"good", "note"}


def _outcome(after: Finding | None) -> str:
    if after is None:
        return "mends it"
    if after.state == "not judged":
        return "it can then not be judged"
    said = "mends it" if _is_mended(after) else "makes it better"
    return said if after.value is None else f"{said}, {_shown(after.value)} {after.unit}".rstrip()


def _shown(value: float) -> str:
    return f"{value:.3g}"


# ------------------------------------------------------------------------------------- candidates, the mildest first


def _candidates(scene: Scene, finding: Finding, limit: float | None) -> Iterator[Changes]:
    spec = scene_numbers(scene)
    safety = spec["safety"]
    match finding.name:
        case "delay margin" | "passivity" | "contact" if has_halves(spec):
            yield from other_gains(scene, spec, shown_delay_s(spec))
        case "delay margin":
            yield from _softer(scene, spec)
        case "wall":
            yield from _softer_wall(spec, finding)
        case "ejection":
            yield from _slower(scene, spec, limit)
        case "ejection of the handle" | "ejection of the trigger":
            yield from _watched(safety, finding)
        case "vfc":
            yield from _sharper_vfc(safety, limit)
        case "hsc":
            yield from _sharper_hsc(finding)
        case "wsc":
            yield from _blunter_wsc(safety, finding)
        case "grip":
            yield (f"safety.limiter.max_force_n={finding.limit:g}",)
        case "outage":
            yield from _longer_holds(safety)
        case "losses" | "link" if finding.name == "losses" or "silent" in finding.text:
            yield from _longer_holds(safety)


def _softer(scene: Scene, spec: dict[str, Any]) -> Iterator[Changes]:
    """Yield the force scale at which the delay of this link is tolerated with margin, by bisection."""
    delays = link_delays_s(spec)
    if delays is None:
        return
    loop = min(scene_loops(scene), key=largest_delay_s)
    low, high = 0.0, loop.force_scale
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        scaled = ContactLoop(**{name: getattr(loop, name) for name in loop.__struct_fields__} | {"force_scale": middle})
        if largest_delay_s(scaled) > delays[1] * MARGIN:
            low = middle
        else:
            high = middle
    if low < 1e-6:
        return
    scale = rounded_down(low)
    coupling = spec["coupling"]
    changes = [f"coupling.force_scale={scale:g}"] if coupling["force_scale"] > scale else []
    for place, state in enumerate(coupling["changes"]):
        if state["force_scale"] is not None and state["force_scale"] > scale:
            changes.append(f"coupling.changes.{place}.force_scale={scale:g}")
    yield tuple(changes)


def _softer_wall(spec: dict[str, Any], finding: Finding) -> Iterator[Changes]:
    if not finding.limit:
        return
    stiffness = rounded_down(finding.limit / MARGIN)
    yield tuple(
        f"environment.objects.{place}.contact.stiffness={stiffness:g}"
        for place, part in enumerate(spec["environment"]["objects"])
        if part["contact"]["law"] == "kelvin-voigt" and part["contact"]["stiffness"] > stiffness
    )


def _slower(scene: Scene, spec: dict[str, Any], limit: float | None) -> Iterator[Changes]:
    """Yield the assumptions that the bound lacks, then VFC, a faster estimator, and a smaller |delta| or cap."""
    safety, master = spec["safety"], spec["master"]
    kind, is_exact = safety["estimator"]["kind"], safety["signals"] == "true" or master["measures_velocity"]
    changes = _within_assumptions(spec)
    if kind == "adaptive-window" and not is_exact:
        changes.append("safety.estimator={kind=dual-kalman}")
    watching = list(safety["controllers"])
    if "wsc" not in watching:
        watching.append("wsc")
        changes.append(_controllers(watching))
    elif safety["wsc_force_threshold_n"] > 0.0 and master["stops"] is None:
        changes.append("safety.wsc_force_threshold_n=0")
    if changes:
        yield tuple(changes)
    yield from _measured(scene, changes)
    if "vfc" not in watching:
        yield (*(one for one in changes if not one.startswith("safety.controllers=")), _controllers([*watching, "vfc"]))
    if kind not in {"dual-kalman", "adaptive-window"} and not is_exact:
        changes.append("safety.estimator={kind=dual-kalman}")
        yield tuple(changes)
    if limit is None:
        return
    with_vfc = tuple(one for one in changes if not one.startswith("safety.controllers="))
    bases = [tuple(changes)]
    if "vfc" not in watching:
        bases.append((*with_vfc, _controllers([*watching, "vfc"])))
    if safety["wsc_force_threshold_n"] > 0.0 and "safety.wsc_force_threshold_n=0" not in changes:
        bases.append((*changes, "safety.wsc_force_threshold_n=0"))
    for base in bases:
        yield from _held_to(scene, base, limit, "energy_threshold_j")
    for base in bases:
        yield from _held_to(scene, base, limit, "max_force_n")
    if safety["limiter"] is not None:
        half = rounded_up(LEAST_SHARE_OF_CAP * safety["limiter"]["max_force_n"])
        uncapped = tuple(one for one in bases[0] if not one.startswith("safety.limiter.max_force_n="))
        yield from _held_to(scene, (*uncapped, f"safety.limiter.max_force_n={half:g}"), limit, "energy_threshold_j")


def _measured(scene: Scene, changes: list[str]) -> Iterator[Changes]:
    """Yield the thresholds of the other preset, which joints do not have."""
    if scene.safety.preset == "paper" and side_kind(scene.master) != "joints":
        yield (*changes, "safety.preset=measured")


def _within_assumptions(spec: dict[str, Any]) -> list[str]:
    """Return the changes that satisfy the assumptions of the bound (docs/ejection_bound.md, A1)."""
    limiter, device_n, environment = spec["safety"]["limiter"], spec["master"]["max_force_n"], spec["environment"]
    changes = []
    if limiter is None:
        changes.append("safety.limiter.enabled=true")
    elif device_n is not None and limiter["max_force_n"] > device_n:
        changes.append(f"safety.limiter.max_force_n={device_n:g}")
    if spec["slave"] is None and environment is not None and environment["rendering"] == "continuous":
        changes.append("environment.rendering=sampled")
    if spec["slave"] is None and spec["safety"]["damping"] <= -min(spec["master"]["viscous"]):
        damping = min(DEFAULT_DAMPING, max_damping(spec["master"]["mass_kg"], spec["run"]["period_s"]))
        changes.append(f"safety.damping={damping:g}")
    return changes


def _held_to(
    scene: Scene, changes: Changes, limit: float, by: Literal["energy_threshold_j", "max_force_n"]
) -> Iterator[Changes]:
    """Yield the largest cap, or |delta|, at which the speed bound equals the limit, by secants over its root.

    No value below `LEAST_ENERGY_J` and `LEAST_SHARE_OF_CAP`.
    """
    try:
        settings = override_scene(scene, changes).ejection_settings()
    except SceneError:
        return
    now = getattr(settings, by)
    if not isfinite(now):
        return

    def speed(share: float) -> float | None:
        return ejection_bound(replace(settings, **{by: now * share**2}), free_s=inf).speed

    least = LEAST_SHARE_OF_CAP if by == "max_force_n" else min(1.0, LEAST_ENERGY_J / abs(now))
    low, high = sqrt(least), 1.0
    below, above = speed(low), speed(high)
    if above is None or below is None or below > limit or above <= limit:
        return
    for _ in range(SECANTS):
        middle = low + (high - low) * (limit - below) / (above - below)
        found = speed(middle)
        if found is None:
            return
        if found <= limit:
            low, below = middle, found
        else:
            high, above = middle, found
        if limit - below < 0.01 * limit:
            break
    others = tuple(one for one in changes if not one.startswith(f"safety.limiter.{by}="))
    value = rounded_down(abs(now) * low**2)
    yield (*others, f"safety.{by}={-value:g}" if by == "energy_threshold_j" else f"safety.limiter.{by}={value:g}")


def _watched(safety: dict[str, Any], finding: Finding) -> Iterator[Changes]:
    table = "rotation" if finding.name.endswith("handle") else "gripper"
    own = (safety[table] or {}).get("controllers")
    yield (_controllers(["wsc"]),) if own is None else (f"safety.{table}.controllers=[wsc]",)


def _sharper_vfc(safety: dict[str, Any], limit: float | None) -> Iterator[Changes]:
    cap_n, force_n, speed = (
        safety["limiter"]["max_force_n"],
        safety["vfc_force_threshold_n"],
        safety["velocity_threshold"],
    )
    if safety["vfc_form"] == "product":
        if limit is not None:
            yield (f"safety.vfc_force_threshold_n={rounded_down(limit * cap_n / speed):g}",)
        return
    changes = []
    if force_n >= cap_n:
        changes.append(f"safety.vfc_force_threshold_n={rounded_down(min(1.0, 0.5 * cap_n)):g}")
    if limit is not None and speed > limit:
        changes.append(f"safety.velocity_threshold={limit:g}")
    yield tuple(changes)


def _sharper_hsc(finding: Finding) -> Iterator[Changes]:
    if finding.state == "bad":
        for force_n in (1.0, 0.1):
            yield (f"safety.hsc_force_threshold_n={force_n:g}",)
        return
    yield ("safety.hsc_velocity_threshold=0.05",)
    if finding.limit:
        yield (f"safety.hsc_force_threshold_n={rounded_up(finding.limit):g}",)


def _blunter_wsc(safety: dict[str, Any], finding: Finding) -> Iterator[Changes]:
    yield ("safety.wsc_force_threshold_n=0.1",)
    # `lasting` = sqrt(2 eta |delta| / m) of the fastest stroke.
    if finding.value and finding.limit:
        threshold_j = abs(safety["energy_threshold_j"]) * (finding.value / finding.limit) ** 2
        yield (f"safety.energy_threshold_j={-rounded_up(threshold_j):g}",)


def _longer_holds(safety: dict[str, Any]) -> Iterator[Changes]:
    for hold_s in HOLDS_AFTER_S:
        if hold_s > safety["ladder"]["hold_after_s"]:
            yield (f"safety.ladder.hold_after_s={hold_s:g}",)


def _controllers(names: list[str]) -> str:
    return f"safety.controllers=[{','.join(names)}]"
