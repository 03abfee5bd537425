"""Cost, delay and noise of the velocity and acceleration estimators, and which one is the default.

A hand touches a wall of 200 N/m 3 mm deep and presses it to 39 mm. It holds with a tremor of 10 Hz at either depth, and
lets go over 50 ms with a grip margin of 1.5. The motion is simulated exactly, without encoder: once with nothing acting
and once with WSC acting, whose device force steps. Then the positions are rounded to a PHANTOM Desktop's quantum at
several sub-quantum offsets. Every estimator gets the same samples. A third run meets the wall at 0.1 m/s, for the false
trips at first touch.

Each estimator also runs against a peer in NumPy and SciPy, which must agree with it.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Literal, TextIO

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.optimize
import scipy.signal
from rich.console import Console
from rich.progress import track

from _report import add_number, bench_options, in_turns, print_table, table_file, write_json
from haptether.bridge import run_local
from haptether.master import Hand, HapticDevice
from haptether.safety import DeviceModel, Estimator, EstimatorKind, SafetyController, SafetySettings
from haptether.slave import Wall

Array = npt.NDArray[np.float64]
Estimate = tuple[Array, Array, Array]
Peer = Callable[[Array, Array], Estimate]

EXAMPLE = "example: python benches/estimators.py --json estimators.json"
RULE = """\
The default is, of the estimators that
  1. err by less than 0.1 N RMS in F_h while the hand holds with a tremor,
  2. keep S_h below 1.5 / 1.1 at every tick until the release with F_v above 0.5 N,
  3. keep S_h above 1.5 * 1.1 once HSC has tripped and nobody holds, until F_v is below 0.5 N,
the one that errs least in F_h (RMS from the first motion to the end).
1.5 is HSC's threshold zeta and 0.5 N its F_t: so it trips neither falsely nor goes off too early,
by a margin of a tenth. 1 and the choice pool both runs and all offsets; 2 and 3 hold for each."""

PERIOD_S = 1e-3
QUANTUM_M = 2.3e-5
OFFSETS = tuple(tenth / 10 for tenth in range(10))
STIFFNESS, TOUCH_M, DEPTH_M = 200.0, 0.003, 0.039
HAND_STIFFNESS, HAND_DAMPING = 300.0, 10.0
GRIP_MARGIN, LET_GO_S = 1.5, 0.05
TREMOR_M, TREMOR_HZ = 3e-4, 10.0
FORCE_THRESHOLD_N, GRASP_THRESHOLD, MARGIN = 0.5, 1.5, 1.1
NOISE_BOUND_N = 0.1
HSC = 2
MAX_TIES = 1e-2
"""Largest share of ticks at which the result of a peer may differ."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Estimator, its parameters in words, and its peer."""

    method: str
    parameters: str
    kind: EstimatorKind
    peer: Peer


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """True values of a run, one per tick."""

    name: str
    position: Array
    velocity: Array
    acceleration: Array
    """Mean over the tick that ends here."""
    hand_force: Array
    rendered_force: Array
    held_force: Array
    """Device force over the tick that ends here."""
    holds: list[slice]
    """Ticks while the hand holds, with a tremor."""
    release: int
    """Tick at which the grip starts to loosen."""
    let_go: int
    """First tick at which nobody holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """Cost and quality of an estimator."""

    method: str
    parameters: str
    ns_per_sample: float
    peer_ns_per_sample: float
    velocity_rms: float
    velocity_delay_ms: float
    acceleration_rms: float
    acceleration_delay_ms: float
    grasp_rms_n: float
    grasp_delay_ms: float
    hold_rms_n: float
    gone_worst_n: float
    """Largest |error| of F_h while nobody holds."""
    trip_ms: float | None
    """Longest time from the start of the release to the first HSC trip; None if no trip follows."""
    trip_late_ms: float | None
    """Same time, from the tick at which HSC would trip on the true hand force."""
    hold_grasp: float
    """Largest S_h until the release with F_v above F_t."""
    gone_grasp: float
    """Least S_h after the trip and the release with F_v above F_t; 0 without trip."""
    false_trips: int
    """Ticks at which HSC trips while the hand holds."""
    touch_trips: int
    """Largest number of ticks with a trip as the hand meets the wall at 0.1 m/s."""
    eligible: bool


# Peers


def before(values: Array, first: float = 0.0) -> Array:
    """Return the values one tick earlier."""
    return np.concatenate(([first], values[:-1]))


def peer_backward_difference(x: Array, force: Array) -> Estimate:
    """Estimate with two calls of `numpy.diff`."""
    velocity = np.diff(x, prepend=x[0]) / PERIOD_S
    return velocity, np.diff(velocity, prepend=0.0) / PERIOD_S, (force + before(force)) / 2


def peer_low_pass(x: Array, force: Array, cutoff_hz: float) -> Estimate:
    """Estimate with `numpy.diff` and `scipy.signal.lfilter`."""
    difference, _, mean = peer_backward_difference(x, force)
    share = -np.expm1(-2 * np.pi * cutoff_hz * PERIOD_S)
    velocity, aligned = (
        np.asarray(scipy.signal.lfilter([share], [1.0, share - 1.0], signal)) for signal in (difference, mean)
    )
    return velocity, np.diff(velocity, prepend=0.0) / PERIOD_S, aligned


def peer_savitzky_golay(x: Array, force: Array, degree: int, window: int) -> Estimate:
    """Estimate with `scipy.signal.savgol_coeffs` at the newest sample and `lfilter`."""
    first, second = (
        scipy.signal.savgol_coeffs(window, degree, deriv=d, delta=PERIOD_S, pos=window - 1) for d in (1, 2)
    )
    # Lag 1 ... window - 1: double sums of the weights from the far end.
    single = np.cumsum((second * PERIOD_S**2)[:0:-1])
    kernel = (np.cumsum(single) - single / 2)[::-1]
    moved = x - x[0]
    return (
        np.asarray(scipy.signal.lfilter(first, [1.0], moved)),
        np.asarray(scipy.signal.lfilter(second, [1.0], moved)),
        np.asarray(scipy.signal.lfilter(kernel, [1.0], force)),
    )


def peer_kalman(x: Array, force: Array, jerk_density: float) -> Estimate:
    """Estimate with `scipy.linalg.solve_discrete_are`, and `lfilter` with the transfer functions."""
    transition = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    noise = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
    noise *= jerk_density * PERIOD_S**5 / (QUANTUM_M**2 / 12)
    seen = np.array([[1.0], [0.0], [0.0]])
    covariance = scipy.linalg.solve_discrete_are(transition.T, seen, noise, np.eye(1))
    gain = covariance[:, :1] / (covariance[0, 0] + 1.0)
    closed = (np.eye(3) - gain @ seen.T) @ transition
    (_, b_v, b_a), a = scipy.signal.ss2tf(closed, gain, closed, gain)
    # Position from force: a double integral, whose poles the numerator of A cancels.
    b_f = np.polymul(np.polydiv(b_a, [1.0, -2.0, 1.0])[0], [0.5, 0.5])
    moved = x - x[0]
    return (
        np.asarray(scipy.signal.lfilter(b_v, a, moved)) / PERIOD_S,
        np.asarray(scipy.signal.lfilter(b_a, a, moved)) / PERIOD_S**2,
        np.asarray(scipy.signal.lfilter(b_f, a, force)),
    )


def peer_adaptive_window(x: Array, force: Array, window: int, fit: str) -> Estimate:
    """Estimate for all ticks at once in NumPy, lag by lag.

    Positions count in quanta: their differences are whole numbers, so a line at its bound is no matter of rounding.
    """
    counts = np.rint(x / QUANTUM_M)
    bound = np.ones_like(x)
    chosen, velocity = widest_lines(counts, bound, window, fit, first=counts[0], first_bound=1.0)
    unsure = 2.0 / chosen
    chosen_again, acceleration = widest_lines(velocity, unsure, window, fit, first=0.0, first_bound=2.0 / window)
    velocity, acceleration = QUANTUM_M * velocity, QUANTUM_M * acceleration
    path = np.cumsum(np.cumsum(force) - force / 2)
    aligned = given_lines(given_lines(path, chosen, window, fit), chosen_again, window, fit)
    return velocity / PERIOD_S, acceleration / PERIOD_S**2, aligned


def slopes(values: Array, window: int, fit: str, first: float) -> list[tuple[Array, Array]]:
    """Return for each lag the rise since then and the slope of the line over that many ticks."""
    padded = np.concatenate((np.full(window, first), values))
    total, moment = np.zeros_like(values), np.zeros_like(values)
    lines = []
    for lag in range(1, window + 1):
        rise = values - padded[window - lag : -lag]
        if fit == "end":
            slope = rise / lag
        else:
            total, moment = total + rise, moment + lag * rise
            slope = 6 * (2 * moment - lag * total) / (lag * (lag + 1.0) * (lag + 2.0))
        lines.append((rise, slope))
    return lines


def widest_lines(
    values: Array, bound: Array, window: int, fit: str, *, first: float, first_bound: float
) -> tuple[Array, Array]:
    """Return the longest window whose line stays within the bound, and its slope."""
    bounds = np.concatenate((np.full(window, first_bound), bound))
    lowest, highest = np.full_like(values, -np.inf), np.full_like(values, np.inf)
    lines = slopes(values, window, fit, first)
    chosen, best = np.ones_like(values), lines[0][0].copy()
    straight = np.ones(len(values), dtype=bool)
    for lag, (rise, slope) in enumerate(lines, start=1):
        limit = np.maximum(bound, bounds[window - lag : -lag])
        lowest = np.maximum(lowest, (rise - limit) / lag)
        highest = np.minimum(highest, (rise + limit) / lag)
        straight &= (lowest <= slope) & (slope <= highest)
        chosen[straight], best[straight] = lag, slope[straight]
    return chosen, best


def given_lines(values: Array, chosen: Array, window: int, fit: str) -> Array:
    """Return the slope over the window chosen at each tick."""
    found = np.zeros_like(values)
    for lag, (_, slope) in enumerate(slopes(values, window, fit, 0.0), start=1):
        found[chosen == lag] = slope[chosen == lag]
    return found


# Measurements


def cases() -> list[Case]:
    """Return all kinds, each with parameters from quick and noisy to slow and smooth."""

    def case(method: str, parameters: str, kind: EstimatorKind, peer: Peer) -> Case:
        return Case(method=method, parameters=parameters, kind=kind, peer=peer)

    found = [case("difference", "", EstimatorKind.backward_difference(), peer_backward_difference)]
    for cutoff_hz in (10.0, 20.0, 30.0, 50.0, 100.0):
        kind = EstimatorKind.low_pass(cutoff_hz=cutoff_hz)
        peer: Peer = partial(peer_low_pass, cutoff_hz=cutoff_hz)
        found.append(case("low-pass", f"{cutoff_hz:g} Hz", kind, peer))
    for fit in ("end", "best"):
        for window in (8, 16, 32, 64):
            kind = EstimatorKind.adaptive_window(noise_bound_m=QUANTUM_M, max_window=window, fit=fit)
            peer = partial(peer_adaptive_window, window=window, fit=fit)
            found.append(case("adaptive", f"{fit}, {window}", kind, peer))
    for degree, windows in ((2, (9, 15, 21, 31, 51)), (3, (21, 31, 35, 41, 51))):
        for window in windows:
            kind = EstimatorKind.savitzky_golay(degree=degree, window=window)
            peer = partial(peer_savitzky_golay, degree=degree, window=window)
            found.append(case("Savitzky-Golay", f"degree {degree}, {window}", kind, peer))
    for jerk_density in (0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 1e3, 1e4):
        kind = EstimatorKind.kalman(jerk_density=jerk_density, quantum_m=QUANTUM_M)
        peer = partial(peer_kalman, jerk_density=jerk_density)
        found.append(case("Kalman", f"q = {jerk_density:g}", kind, peer))
    return found


def simulate(controllers: Sequence[Literal["wsc"]], depths_m: Sequence[float]) -> Run:
    """Simulate a hand that presses, holds with a tremor at each depth, and lets go."""
    legs: list[tuple[float, float, Literal["linear", "minimum-jerk"]]] = []
    holds: list[slice] = []
    for depth_m in depths_m:
        target = -depth_m * (1 + STIFFNESS / HAND_STIFFNESS)
        legs += [(0.8, target, "minimum-jerk"), (0.2, target, "linear")]
        begun_s = sum(leg[0] for leg in legs)
        sway = [target + TREMOR_M * side for side in (1, -1)] * 5
        legs += [(0.5 / TREMOR_HZ, end, "minimum-jerk") for end in [*sway, target]]
        holds.append(slice(round(begun_s / PERIOD_S), round(sum(leg[0] for leg in legs) / PERIOD_S)))
    release_s = sum(leg[0] for leg in legs) + 0.1
    hand = Hand(
        stiffness=HAND_STIFFNESS,
        damping=HAND_DAMPING,
        strength_n=GRIP_MARGIN * STIFFNESS * DEPTH_M,
        start=0.01,
        legs=legs,
        release=(release_s, LET_GO_S),
    )
    trace = run_local(
        HapticDevice.phantom_desktop(encoder_quantum=0.0),
        hand,
        Wall(stiffness=STIFFNESS),
        ticks=round((release_s + 0.35) / PERIOD_S),
        settings=SafetySettings(controllers),
        period_s=PERIOD_S,
    )
    return Run(
        name="+".join(controllers) or "none",
        position=trace.position,
        velocity=trace.velocity,
        acceleration=np.diff(trace.velocity, prepend=0.0) / PERIOD_S,
        hand_force=trace.hand_force,
        rendered_force=trace.rendered_force,
        held_force=before(trace.device_force),
        holds=holds,
        release=round(release_s / PERIOD_S),
        let_go=round((release_s + LET_GO_S) / PERIOD_S),
    )


def watch_grasp(
    run: Run, velocity: Array, grasp_force: Array, aligned_rendered: Array | None = None
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return S_h and the ticks at which HSC reports an unsafe hand; F_v is as late as F_h, as in the safety layer."""
    settings = SafetySettings(["hsc"], hsc_force_threshold_n=FORCE_THRESHOLD_N, grasp_threshold=GRASP_THRESHOLD)
    controller = SafetyController(DeviceModel.phantom_desktop(), settings, period_s=PERIOD_S)
    seen = controller.run(velocity, run.rendered_force, grasp_force, aligned_rendered)
    assert seen.grasp is not None
    return seen.grasp, (seen.tripped & HSC) > 0


def first_trip(run: Run, trips: npt.NDArray[np.bool_]) -> int | None:
    """Return the first tick with a trip after the release."""
    after = trips[run.release :]
    return run.release + int(after.argmax()) if after.any() else None


def quantised(run: Run, offset: float) -> Array:
    """Return the positions from an encoder whose lines are shifted by `offset` quanta."""
    return np.round(run.position / QUANTUM_M + offset) * QUANTUM_M


def worst_ms(ticks: list[int | None]) -> float | None:
    """Return the longest time in ms; None if one tick is missing."""
    found = [tick for tick in ticks if tick is not None]
    return max(found) * PERIOD_S * 1e3 if len(found) == len(ticks) else None


def rms(error: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(error**2)))


def delay_ms(estimates: list[Array], truths: list[Array]) -> float:
    """Return the shift of the truth with the least RMS error, also between ticks."""

    def left(shift: float) -> float:
        error = 0.0
        for estimate, truth in zip(estimates, truths, strict=True):
            ticks = np.arange(len(truth), dtype=np.float64)
            error += float(np.sum((estimate - np.interp(ticks - shift, ticks, truth)) ** 2))
        return error

    coarse = np.arange(-1.0, 60.0)
    near = float(coarse[np.argmin([left(shift) for shift in coarse])])
    best = scipy.optimize.minimize_scalar(left, bounds=(near - 1, near + 1), method="bounded")
    return float(best.x) * PERIOD_S * 1e3


def judge(case: Case, runs: list[Run], fast: Run) -> Score:
    """Return errors, delays and trips over all runs and offsets; the times stay zero."""
    device = DeviceModel.phantom_desktop()
    seen: dict[str, tuple[list[Array], list[Array]]] = {"v": ([], []), "a": ([], []), "f": ([], [])}
    held: list[Array] = []
    trip_ticks: list[int | None] = []
    late_ticks: list[int | None] = []
    gone_worst_n, hold_grasp, gone_grasp, false = 0.0, 0.0, float("inf"), 0
    for run in runs:
        true_trip = first_trip(run, watch_grasp(run, run.velocity, run.hand_force)[1])
        assert true_trip is not None
        ticks = np.arange(len(run.position))
        pushing = run.rendered_force > FORCE_THRESHOLD_N  # S_h counts only there
        for offset in OFFSETS:
            position = quantised(run, offset)
            velocity, acceleration, aligned = estimate(case, position, run.held_force)
            agree(case, position, run.held_force)
            grasp_force = device.grasp_force(velocity, acceleration, aligned)
            for name, found, truth in (
                ("v", velocity, run.velocity),
                ("a", acceleration, run.acceleration),
                ("f", grasp_force, run.hand_force),
            ):
                seen[name][0].append(found)
                seen[name][1].append(truth)
            error = grasp_force - run.hand_force
            held.extend(error[hold] for hold in run.holds)
            gone_worst_n = max(gone_worst_n, float(np.abs(error[run.let_go :]).max()))
            grasp, trips = watch_grasp(run, velocity, grasp_force, align_rendered(case, run, position))
            false += int(trips[: run.release].sum())
            hold_grasp = max(hold_grasp, float(grasp[pushing & (ticks < run.release)].max()))
            trip = first_trip(run, trips)
            trip_ticks.append(None if trip is None else trip - run.release)
            late_ticks.append(None if trip is None else trip - true_trip)
            gone = pushing & (ticks >= max(run.let_go, len(ticks) if trip is None else trip))
            gone_grasp = min(gone_grasp, float(grasp[gone].min()) if gone.any() else 0.0)
    errors = {name: np.concatenate(a) - np.concatenate(b) for name, (a, b) in seen.items()}
    hold_rms = rms(np.concatenate(held))
    return Score(
        method=case.method,
        parameters=case.parameters,
        ns_per_sample=0.0,
        peer_ns_per_sample=0.0,
        velocity_rms=rms(errors["v"]),
        velocity_delay_ms=delay_ms(*seen["v"]),
        acceleration_rms=rms(errors["a"]),
        acceleration_delay_ms=delay_ms(*seen["a"]),
        grasp_rms_n=rms(errors["f"]),
        grasp_delay_ms=delay_ms(*seen["f"]),
        hold_rms_n=hold_rms,
        gone_worst_n=gone_worst_n,
        trip_ms=worst_ms(trip_ticks),
        trip_late_ms=worst_ms(late_ticks),
        hold_grasp=hold_grasp,
        gone_grasp=gone_grasp,
        false_trips=false,
        touch_trips=max(false_ticks(case, fast, offset) for offset in OFFSETS),
        eligible=hold_rms < NOISE_BOUND_N
        and hold_grasp < GRASP_THRESHOLD / MARGIN
        and gone_grasp > GRASP_THRESHOLD * MARGIN,
    )


def false_ticks(case: Case, run: Run, offset: float) -> int:
    """Return the ticks with a trip until the release."""
    position = quantised(run, offset)
    velocity, acceleration, aligned = estimate(case, position, run.held_force)
    grasp_force = DeviceModel.phantom_desktop().grasp_force(velocity, acceleration, aligned)
    trips = watch_grasp(run, velocity, grasp_force, align_rendered(case, run, position))[1]
    return int(trips[: run.release].sum())


def align_rendered(case: Case, run: Run, position: Array) -> Array:
    """Filter F_v with the estimator's kernel."""
    return estimate(case, position, before(run.rendered_force))[2]


def estimate(case: Case, position: Array, held_force: Array) -> Estimate:
    """Run a fresh estimator over all samples."""
    velocity, acceleration, aligned = Estimator(case.kind, period_s=PERIOD_S).run(position, held_force)
    assert aligned is not None
    return velocity, acceleration, aligned


def agree(case: Case, position: Array, held_force: Array) -> None:
    """Refuse a peer with a different result: its time would be no comparison.

    Windows of velocities differ where a line lies at its bound but for rounding.
    """
    for name, ours, theirs in zip(
        ("velocity", "acceleration", "aligned force"),
        estimate(case, position, held_force),
        case.peer(position, held_force),
        strict=True,
    ):
        share = float((np.abs(ours - theirs) > 1e-6 * np.abs(ours).max()).mean())
        if share > MAX_TIES:
            percent = 100.0 * share
            sys.exit(f"{case.method} {case.parameters}: the peer's {name} differs at {percent:.3g} % of the ticks")


def measure(case: Case, runs: list[Run], fast: Run, samples: int, repeats: int) -> Score:
    """Return the whole score."""
    run = runs[-1]
    tiles = -(-samples // len(run.position))
    position = np.tile(quantised(run, OFFSETS[0]), tiles)[:samples]
    force = np.tile(run.held_force, tiles)[:samples]
    estimator = Estimator(case.kind, period_s=PERIOD_S)
    works = {"ours": lambda: estimator.run(position, force), "peer": lambda: case.peer(position, force)}
    ns = {name: min(times) / samples for name, times in in_turns(works, range(repeats)).items()}
    return replace(judge(case, runs, fast), ns_per_sample=ns["ours"], peer_ns_per_sample=ns["peer"])


def report(scores: list[Score], chosen: Score | None, out: TextIO) -> None:
    """Print the table."""
    heads = ("estimator", "ns", "peer/x", "V", "V-ms", "A", "A-ms", "F_h", "F-ms", "hold", "gone", "trip", "late",
             "hold-S", "gone-S", "false", "touch")  # fmt: skip
    rows = (
        (
            f"{'*' if one is chosen else '+' if one.eligible else ' '} {one.method} {one.parameters}",
            f"{one.ns_per_sample:.1f}", f"{one.peer_ns_per_sample / one.ns_per_sample:.1f}",
            f"{one.velocity_rms:.4f}", f"{one.velocity_delay_ms:.2f}",
            f"{one.acceleration_rms:.2f}", f"{one.acceleration_delay_ms:.2f}",
            f"{one.grasp_rms_n:.3f}", f"{one.grasp_delay_ms:.2f}", f"{one.hold_rms_n:.3f}", f"{one.gone_worst_n:.2f}",
            *("never" if ms is None else f"{ms:.0f}" for ms in (one.trip_ms, one.trip_late_ms)),
            f"{one.hold_grasp:.3g}", f"{one.gone_grasp:.2f}", one.false_trips, one.touch_trips,
        )
        for one in scores
    )  # fmt: skip
    print_table(heads, rows, out)
    legend = """
ns: per sample, with alignment; peer/x: time of the NumPy/SciPy peer over ours
V m/s, A m/s2, F_h N: RMS error; -ms: delay that explains the estimate best
hold N: RMS error of F_h while the hand holds with a tremor; gone N: worst error while nobody holds
trip: ms from the begin of the release to the first HSC trip; late: after the trip on the true force
hold-S: largest S_h until the release; gone-S: least S_h once tripped and let go
false: ticks with a trip until the release; touch: most such ticks when meeting the wall at 0.1 m/s
+ fulfils 1 to 3 of the rule, * chosen
"""
    print(legend, file=out)
    print(RULE, file=out)


def main() -> int:
    """Measure, print, and check the default."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--samples", 100_000, "for timing")
    add_number(options, "--repeats", 5, "the least time counts")
    arguments = options.parse_args()

    out = table_file(arguments.json)
    runs = [simulate([], (TOUCH_M, DEPTH_M)), simulate(["wsc"], (TOUCH_M, DEPTH_M))]
    fast = simulate([], (DEPTH_M,))
    every = cases()
    console = Console(stderr=True)
    scores = [
        measure(case, runs, fast, arguments.samples, arguments.repeats)
        for case in track(every, "estimators", console=console, transient=True)
    ]
    eligible = [score for score in scores if score.eligible]
    chosen = min(eligible, key=lambda score: score.grasp_rms_n, default=None)
    report(scores, chosen, out)
    if chosen is None:
        print("\nno estimator fulfils 1 to 3 of the rule", file=sys.stderr)
        return 1
    chosen_case = every[scores.index(chosen)]
    is_default = chosen_case.kind == EstimatorKind()
    verdict = "it is the default" if is_default else f"but the default is {EstimatorKind()}"
    print(f"\nchosen: {chosen.method} {chosen.parameters}; {verdict}", file=out)
    write_json(
        arguments.json,
        {
            "rule": RULE,
            "chosen": repr(chosen_case.kind),
            "default": repr(EstimatorKind()),
            "period_s": PERIOD_S,
            "quantum_m": QUANTUM_M,
            "estimators": [asdict(score) for score in scores],
        },
    )
    return 0 if is_default else 1


if __name__ == "__main__":
    sys.exit(main())
