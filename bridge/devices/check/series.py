"""Checks across the samples of a run: period, blocking calls, units, jumps, and consistent velocity."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haptether.bridge.devices.check.finding import Finding
from haptether.bridge.devices.check.form import Kind, Reading
from haptether.bridge.devices.standalone import Tick
from haptether.safety import Renewal, SampleBounds

Array = NDArray[np.float64]

BLOCKED_S = 0.02
"""A call longer than this, in s, makes both sides hold."""
FIRST_READ_S = 1.0
"""Limit in s of the first `read`, which may give an arm its torque; nothing is coupled yet. Same as in the loop."""
PERIOD_SHARE = 0.01
"""Allowed relative error of `period_s`, same as between a scene and its device."""
WINDOW_S = 0.05
"""Window in s over which the integrated velocity is compared with the change of position."""
JUMPS_WITHIN_S = 1e-3
"""Shortest sample interval in s used for the jump check."""
FEW = 5
"""Smallest number of windows with motion that allows a verdict."""
AGREES = 0.25
"""Allowed relative error of the integrated velocity."""
DISAGREEING = 0.1
"""Allowed fraction of windows above that error."""


@dataclass(frozen=True)
class Bounds:
    """Plausible range of a kind of device, and the unit that a value beyond it suggests."""

    unit: str
    other: str
    farthest: float
    """Largest distance from 0 in m (rad)."""
    fastest: float
    """Largest speed between two samples in m/s (rad/s)."""
    motion: float
    """Smallest motion within a window, in m (rad), that allows a velocity check."""


LINEAR = Bounds("m", "mm", farthest=5.0, fastest=SampleBounds().speed, motion=1e-3)
JOINTS = Bounds("rad", "degrees", farthest=8.0 * math.pi, fastest=SampleBounds(joints=True).speed, motion=1e-2)
FACTORS = {
    -1.0: "its sign is wrong", 1e3: "it is in mm/s", 1e-3: "the position is in mm", 0.0: "it is zero all the time",
    180.0 / math.pi: "it is in degrees/s", math.pi / 180.0: "the position is in degrees",
}  # fmt: skip
"""Ratio of integrated velocity to change of position for each common error."""


def bounds_of(kind: Kind, speed_bound: float | None = None) -> Bounds:
    """Return the bounds of a kind of coordinates; a driver may set its own speed bound."""
    of = JOINTS if kind == "joints" else LINEAR
    return of if speed_bound is None else replace(of, fastest=speed_bound)


@dataclass(frozen=True)
class Timing:
    """Percentiles in s for a loop that has the interpreter to itself but no real-time priority."""

    rate_hz: float
    period_p50_s: float
    period_p99_s: float
    period_max_s: float
    read_p50_s: float
    read_p99_s: float
    read_max_s: float
    write_p50_s: float
    write_p99_s: float
    write_max_s: float


def timing(ticks: Sequence[Tick]) -> Timing | None:
    """Return the timing of two or more ticks."""
    if len(ticks) < 2:
        return None
    asked, read, written = (np.array([tick[index] for tick in ticks]) for index in range(3))
    periods = np.diff(read)
    figures: list[float] = []
    for times in (periods, read - asked, written - read):
        figures += [*np.percentile(times, [50, 99]).tolist(), float(times.max())]
    return Timing((len(ticks) - 1) / float(read[-1] - read[0]), *figures)


def check_period(of: Timing | None, *, paces: bool, said_s: object, loop_s: float) -> Finding:
    """Compare the measured period with the period that the driver declares."""
    if of is None:
        return Finding("period", "unseen", "fewer than two samples")
    seen_s = of.period_p50_s
    seen = f"a sample each {1e3 * seen_s:.3f} ms (p99 {1e3 * of.period_p99_s:.3f}, max {1e3 * of.period_max_s:.3f})"
    if not paces:
        if said_s is not None:
            return Finding("period", "note", f"{seen}; period_s = {said_s} counts only of a driver with paces = True")
        return Finding("period", "pass", f"{seen}: the loop keeps the time, at {1e3 * loop_s:g} ms")
    return _paced(of, seen, said_s)


def _paced(of: Timing, seen: str, said_s: object) -> Finding:
    """Check the period of a driver that waits for its samples."""
    if of.read_p50_s < 5e-5 and of.period_p50_s < 4e-4:
        return Finding("period", "mend", f"{seen}: read() does not wait for a sample: wait there, or set paces = False")
    if said_s is None:
        text = f"{seen}; without period_s a scene of another period is not refused: let the driver have period_s"
        return Finding("period", "note", text)
    if isinstance(said_s, bool) or not isinstance(said_s, int | float) or not 0.0 < said_s < math.inf:
        return Finding("period", "mend", f"period_s = {said_s!r}: must be a number of seconds, above 0")
    mean_s = 1.0 / of.rate_hz
    if min(abs(of.period_p50_s - said_s), abs(mean_s - said_s)) > 2.0 * PERIOD_SHARE * said_s:
        text = f"{seen}, {1e3 * mean_s:.3f} ms on average, but period_s = {said_s:g}: must be the seconds between two"
        return Finding("period", "mend", text)
    return Finding("period", "pass", f"{seen}, period_s = {said_s:g}")


def check_blocking(ticks: Sequence[Tick], *, paces: bool, said_s: object) -> Finding:
    """Check that each call returns within 20 ms, plus the period if it waits for the next sample; the first in 1 s."""
    waits_s = said_s if paces and isinstance(said_s, int | float) and math.isfinite(said_s) else 0.0
    limits = {"read": BLOCKED_S + (waits_s if waits_s > BLOCKED_S else 0.0), "write": BLOCKED_S}
    took = {
        "read": [tick.read_s - tick.asked_s for tick in ticks[1:]],
        "write": [tick.written_s - tick.read_s for tick in ticks if tick.force is not None],
    }
    if not ticks:
        return Finding("blocking calls", "unseen", "there was no sample")
    first_s = ticks[0].read_s - ticks[0].asked_s
    late = [f"the first read() took {first_s:.1f} s: must be at most {FIRST_READ_S:g} s"] * (first_s > FIRST_READ_S)
    late += [
        f"{name}() took longer than {1e3 * BLOCKED_S:g} ms {sum(time_s > limits[name] for time_s in times)} times, "
        f"at most {1e3 * max(times):.0f} ms"
        for name, times in took.items()
        if any(time_s > limits[name] for time_s in times)
    ]
    if not late:
        worst = [f"{name}() at most {1e3 * max(times):.2f} ms" for name, times in took.items() if times]
        return Finding("blocking calls", "pass", ", ".join([*worst, f"the first read() {1e3 * first_s:.2f} ms"]))
    text = f"{'; '.join(late)}: it holds both sides; wait on a thread of the driver's own, and return the newest sample"
    return Finding("blocking calls", "mend", text)


def check_positions(time_s: Array, position: Array, kind: Kind, speed_bound: float | None = None) -> list[Finding]:
    """Check positions for a plausible unit and for jumps.

    Args:
        time_s: Sample times, shape `(n,)`.
        position: Positions in m (rad), shape `(n, axes)`.
        kind: Kind of coordinates.
        speed_bound: Speed bound of the driver in m/s (rad/s); by default that of the kind, as in the safety layer.
    """
    of = bounds_of(kind, speed_bound)
    if len(time_s) < 2:
        return [Finding(name, "unseen", "fewer than two samples") for name in ("units", "jumps")]
    found = []
    largest = float(np.abs(position).max())
    steps, dt = np.abs(np.diff(position, axis=0)), np.maximum(np.diff(time_s), 1e-4)[:, None]
    jumps = steps > of.fastest * np.maximum(dt, JUMPS_WITHIN_S)
    # Speed over 50 ms, so that a jump does not count as motion.
    wide = max(1, round(WINDOW_S / max(1e-4, float(np.median(dt)))))
    moved = np.abs(position[wide:] - position[:-wide]) if len(position) > wide else steps
    spanned = (time_s[wide:] - time_s[:-wide])[:, None] if len(position) > wide else dt
    speed = float((moved / spanned).max())
    if largest > of.farthest:
        text = f"a position of {largest:.4g} {of.unit}: given in {of.other}? must be in {of.unit}"
        found.append(Finding("units", "mend", text))
    elif speed > of.fastest and not jumps.any():
        text = f"it moved at {speed:.3g} {of.unit}/s: given in {of.other}? must be in {of.unit}"
        found.append(Finding("units", "mend", text))
    else:
        text = f"at most {largest:.4g} {of.unit} and {speed:.3g} {of.unit}/s" + (
            "" if not jumps.any() else " and jumps"
        )
        found.append(Finding("units", "pass", f"{text}: can be {of.unit}"))
    if not jumps.any():
        found.append(Finding("jumps", "pass", f"at most {float(steps.max()):.3g} {of.unit} between two samples"))
        return found
    index, axis = (int(part[0]) for part in np.nonzero(jumps))
    by = float(steps[index, axis])
    turn = " (it wraps: must go on beyond a turn)" if kind == "joints" and abs(by - 2.0 * math.pi) < 0.2 else ""
    text = (
        f"axis {axis} jumps by {by:.4g} {of.unit} within {1e3 * float(dt[index, 0]):.2f} ms{turn}, "
        f"{int(jumps.sum())} times, faster than {of.fastest:g} {of.unit}/s: one that stays is a fault"
    )
    found.append(Finding("jumps", "mend", text))
    return found


def check_motion(position: Array, kind: Kind) -> Finding:
    """Check that each axis moved, which the velocity check requires."""
    of = bounds_of(kind)
    spans = np.ptp(position, axis=0) if len(position) else np.zeros(0)
    still = [str(axis) for axis, span in enumerate(spans) if span < 5.0 * of.motion]
    text = f"{', '.join(f'{span:.3g}' for span in spans)} {of.unit} from end to end"
    if still or not len(spans):
        return Finding("motion", "unseen", f"{text}: axis {', '.join(still) or '-'} did not move")
    return Finding("motion", "pass", text)


def check_renewal(time_s: Array, readings: Sequence[Reading], loop_s: float, key: str) -> Finding:
    """Check that the device has a new sample at each tick, over what it moves.

    Args:
        time_s: When the samples were read, shape `(n,)`.
        readings: Their numbers.
        loop_s: Period of the loop in s.
        key: Of a scene, that has this period.
    """
    renewal = Renewal()
    late = np.abs(np.diff(time_s, prepend=time_s[0] - 2.0 * loop_s) - loop_s) >= 0.5 * loop_s
    for reading, is_late in zip(readings, late, strict=True):
        if reading.fault is not None:
            renewal.interrupt()
            continue
        renewal.step(
            reading.position, orientation=reading.orientation, time_s=reading.time_s, is_late=bool(is_late)
        )  # fmt: skip
    share = renewal.total_share
    if share is None:
        return Finding("renewal", "unseen", _unmeasured(readings, late, renewal.unclear))
    seen = f"a new sample at {100.0 * share:.0f} % of the reads, one each {1e3 * loop_s / share:.3g} ms"
    if share >= renewal.MIN_SHARE:
        return Finding("renewal", "pass", seen)
    text = (
        f"{seen}: must be one each {1e3 * loop_s:.3g} ms, the period of the loop; set {key} = {loop_s / share:.2g},"
        " raise the rate of the driver, or have read() wait for each sample"
    )
    return Finding("renewal", "mend", text)


def _unmeasured(readings: Sequence[Reading], late: NDArray[np.bool_], unclear: int) -> str:
    """Why the renewal is not known, and what to do."""
    first = readings[0]
    if all(each.position == first.position and each.orientation == first.orientation for each in readings):
        return "it did not move: move it along every axis"
    if unclear:
        return (
            "it moved by a few of its smallest steps per sample, as a coarse encoder does: move it faster, and unevenly"
        )
    if 2 * int(np.sum(late)) > len(late):
        return "more than half of the reads were late: run it with real time, or on a machine that is less busy"
    return "it moved too briefly: move it for longer"


def check_velocity(time_s: Array, position: Array, velocity: Array, kind: Kind) -> Finding:
    """Compare the velocity integrated over 50 ms with the change of position on each axis."""
    of = bounds_of(kind)
    changes, sums = _windows(time_s, position, velocity)
    return _agreement("velocity", of, changes, sums)


def check_angular_velocity(time_s: Array, orientation: Array, angular_velocity: Array) -> Finding:
    """Compare the angular velocity integrated over 50 ms with the change of orientation, in the base frame."""
    starts, ends = _edges(time_s)
    if not len(starts):
        return Finding("angular velocity", "unseen", "too short a run")
    sums = _sums(time_s, angular_velocity, starts, ends)
    turns = _rotation_vectors(orientation[ends], orientation[starts], base=True)
    found = _agreement("angular velocity", JOINTS, turns, sums)
    if found.verdict == "mend":
        own = _rotation_vectors(orientation[ends], orientation[starts], base=False)
        if _agreement("angular velocity", JOINTS, own, sums).verdict == "pass":
            text = "it is in the device's own frame: must be in that of the base, base_from_tool w"
            return Finding("angular velocity", "mend", text)
    return found


def check_force(force: Array, position: Array, kind: Kind) -> Finding:
    """Report the force that an arm measures."""
    unit = "N m" if kind == "joints" else "N"
    largest = float(np.abs(force).max())
    text = f"at most {largest:.3g} {unit}, {', '.join(f'{mean:.3g}' for mean in force.mean(axis=0))} on average"
    if largest > 1e3:
        return Finding("force", "mend", f"{text}: in mN, or in counts of a sensor? must be in {unit}")
    if float(np.abs(force.mean(axis=0)).max()) > 5.0 and float(np.ptp(position, axis=0).max()) < bounds_of(kind).motion:
        return Finding("force", "note", f"{text}, at rest: does it touch nothing, and is its sensor zeroed?")
    return Finding("force", "pass", text)


def readings_of(ticks: Sequence[Tick], readings: Sequence[Reading | None]) -> tuple[Array, list[Reading]]:
    """Return times and numbers of the samples that the bridge would accept."""
    both = [(tick.read_s, reading) for tick, reading in zip(ticks, readings, strict=False) if reading is not None]
    return np.array([time_s for time_s, _ in both]), [reading for _, reading in both]


# ------------------------------------------------------------------------------------------------ windows


def _edges(time_s: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    if len(time_s) < 3 or time_s[-1] - time_s[0] < 2.0 * WINDOW_S:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    at = np.arange(time_s[0], time_s[-1] - WINDOW_S, 0.5 * WINDOW_S)
    return np.searchsorted(time_s, at), np.searchsorted(time_s, at + WINDOW_S)


def _sums(time_s: Array, rate: Array, starts: NDArray[np.intp], ends: NDArray[np.intp]) -> Array:
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time_s)[:, None]
    total = np.vstack([np.zeros((1, rate.shape[1])), np.cumsum(steps, axis=0)])
    return np.asarray(total[ends] - total[starts])


def _windows(time_s: Array, position: Array, velocity: Array) -> tuple[Array, Array]:
    starts, ends = _edges(time_s)
    return position[ends] - position[starts], _sums(time_s, velocity, starts, ends)


def _agreement(check: str, of: Bounds, changes: Array, sums: Array) -> Finding:
    unseen, worst = [], 0.0
    for axis in range(changes.shape[1] if len(changes) else 0):
        change, total = changes[:, axis], sums[:, axis]
        moves = np.abs(change) > of.motion
        off = np.abs(total - change) > np.maximum(AGREES * np.abs(change), of.motion)
        if off.sum() > max(2.0, DISAGREEING * max(float(moves.sum()), 0.2 * len(change))):
            return Finding(check, "mend", f"axis {axis}: {_why(change, total, moves, of)}")
        if moves.sum() < FEW:
            unseen.append(axis)
        else:
            worst = max(worst, abs(float(change @ total / (change @ change)) - 1.0))
    if not len(changes) or len(unseen) == changes.shape[1]:
        return Finding(check, "unseen", "it hardly moved, and was at rest as it says")
    rest = f"; axis {', '.join(map(str, unseen))} hardly moved" if unseen else ""
    return Finding(check, "pass", f"is that of the positions within {100.0 * worst:.1f} %{rest}")


def _why(change: Array, total: Array, moves: NDArray[np.bool_], of: Bounds) -> str:
    if moves.sum() < FEW:
        return f"at rest it says {np.abs(total).mean() / WINDOW_S:.3g} {of.unit}/s: must be 0 there"
    slope = float(change @ total / (change @ change))
    for factor, why in FACTORS.items():
        near = abs(slope) < 0.02 if factor == 0.0 else 0.8 < slope / factor < 1.25
        if near:
            return f"{why}: it is {slope:.3g} times the change of position"
    return f"it is {slope:.3g} times the change of position, or late: must be dx/dt in {of.unit}/s"


def _rotation_vectors(after: Array, before: Array, *, base: bool) -> Array:
    """log(R_after R_before^T), or log(R_before^T R_after) in the device's own frame, of `quat_wxyz`."""
    inverse = before * np.array([1.0, -1.0, -1.0, -1.0])
    w, *xyz = _product(after, inverse) if base else _product(inverse, after)
    sign = np.where(w < 0.0, -1.0, 1.0)
    vector = np.stack(xyz, axis=1) * sign[:, None]
    sine = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(sine, w * sign)
    return np.asarray(vector * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)[:, None])


def _product(a: Array, b: Array) -> tuple[Array, Array, Array, Array]:
    """Hamilton product of quaternions w, x, y, z, row by row."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )
