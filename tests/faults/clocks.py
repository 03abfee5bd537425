"""Wrong clocks, in virtual time."""

from collections.abc import Callable
from functools import partial

import numpy as np
from tests.faults.rows import Complaints, Row
from tests.faults.signals import HOLD, NAMES

from haptether.bridge import Run, simulate

STEP_S = 1.0
"""Time of a clock's jump, in s."""
QUIET = [f"link.{direction}.{key}=0" for direction in ("forward", "backward") for key in ("loss", "jitter_s")]


def offset(side: str, offset_s: float) -> Row:
    """Shift the clock of one side by a constant offset: it must have no effect."""
    right, wrong = (
        simulate("remote_push"),
        simulate("remote_push", overrides=[f"link.{side}_clock.offset_s={offset_s}"]),
    )
    differ = [name for name, values in right.signals.items() if values.tobytes() != wrong.signals[name].tobytes()]
    found = Complaints()
    found.check(not differ, f"differ: {', '.join(differ)}")
    found.check(right.events == wrong.events, "other events")
    return Row(
        fault=f"clock of the {side} off by {offset_s:+g} s", how="virtual", expected="not a byte changes",
        measured=f"{len(right.signals)} signals the same" if not differ else f"differ: {', '.join(differ)}",
        moved_m=_difference(right, wrong), complaints=found.all(),
    )  # fmt: skip


def jump(side: str, step_s: float, expected: str) -> Row:
    """Make the monotonic clock of one side jump forward, as after a suspend: like a loop that slept."""
    run = simulate("remote_push", overrides=[
        *QUIET, "record.every=1", f"link.{side}_clock.step_s={step_s}", f"link.{side}_clock.step_at_s={STEP_S}",
    ])  # fmt: skip
    mine, time = ("state", "time_s") if side == "master" else ("slave_state", "slave_time_s")
    time_s, state = np.asarray(run.signals[time]), np.asarray(run.signals[mine])
    after = time_s >= STEP_S - 1e-9
    held = after & (state >= HOLD)
    worst = NAMES[int(state[after].max())]
    found = Complaints()
    found.check(worst == expected, f"went to {worst}, must be {expected}")
    took_s = float(time_s[held][0]) - STEP_S if held.any() else None
    limit_s = 0.002 if expected != "stale" else None
    if took_s is not None and limit_s is not None:
        found.check(took_s <= limit_s, f"held after {took_s:g} s, must be {limit_s:g} s at most")
    far = np.asarray(run.signals["slave_state"]) >= HOLD
    command = np.asarray(run.signals["slave_command"]).reshape(-1)
    moved_m = float(np.abs(np.diff(command))[far[:-1] & far[1:]].sum())
    found.check(moved_m == 0.0, f"the command travelled {moved_m:g} m while the slave held")
    return Row(
        fault=f"monotonic clock of the {side} jumps {step_s * 1e3:g} ms", how="virtual",
        expected=f"{expected}, as a loop that slept", measured=worst, reaction_s=took_s, limit_s=limit_s,
        moved_m=moved_m, complaints=found.all(),
    )  # fmt: skip


def _difference(one: Run, other: Run) -> float:
    commands = [np.asarray(run.signals["slave_command"]).reshape(-1) for run in (one, other)]
    return float(np.abs(commands[0] - commands[1]).max())


def rows() -> list[Callable[[], Row]]:
    """Return all rows, to run one after the other."""
    found: list[Callable[[], Row]] = []
    for side in ("master", "slave"):
        found += [partial(offset, side, by) for by in (-1e6, 4e9)]
        found += [partial(jump, side, by, to) for by, to in ((0.1, "hold"), (1.0, "stop"))]
    return found
