"""Faults of processes: real masters and slaves over loopback, in a secure session."""

import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from tests.faults.rows import Complaints, Row
from tests.faults.running import AGAIN_S, PRESSED_S, Process, Recorded, Stage
from tests.faults.signals import HOLD, NAMES, STOP
from tests.faults.virtual import FADE_S, HOLD_S, PERIOD_S, causes

from haptether.bridge import write_key

ATTEMPTS = 3
"""A machine that stalls a loop before the fault makes it hold, which is correct: the row is then repeated."""
STALL_S, STALL_BEFORE_S = 0.008, 0.25
"""Lateness in s of a loop that excuses a hold within `STALL_BEFORE_S`: the limit of `Limits` for a wake."""
SOUND_S = 1.0
"""Least time in s from engaging to the fault."""
KILLED_SLAVE = "slave: SIGKILL, then started anew"
KILLED_MASTER = "master: SIGKILL, then started anew"
RESTARTED_MASTER = "master: SIGTERM, then started anew"
WRONG_KEY = "wrong key"
SECOND_MASTER = "second master with the key"


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Longest permitted times, for loops that a machine may wake late."""

    hold_s: float = HOLD_S + 2 * PERIOD_S + 0.008
    """Silence in s at HOLD: 20 ms over the expected age of one tick, and wakes up to 8 ms late."""
    fade_s: float = FADE_S + 2 * PERIOD_S
    """Time in s from HOLD to zero force; in ticks of the loop, whose times are its deadlines."""


class DisturbedError(Exception):
    """A side held before the fault."""


def undisturbed(recorded: Recorded) -> None:
    """Refuse a run that had not engaged soundly before the fault.

    Raises:
        DisturbedError: It had not engaged, or held too early.
    """
    ticks = recorded.ticks
    engaged = np.flatnonzero(ticks.coupled)
    held = ticks.first(HOLD)
    if not engaged.size:
        raise DisturbedError("never engaged")
    if held is not None and ticks.time_s[held] < ticks.time_s[engaged[0]] + SOUND_S:
        raise DisturbedError(f"held {ticks.time_s[held] - ticks.time_s[engaged[0]]:.3f} s after engaging")


def again(measure: Callable[[], Row], fault: str) -> Callable[[], Row]:
    """Repeat a measurement that the machine disturbed; after `ATTEMPTS` the row has failed."""

    def measured() -> Row:
        reason = ""
        for attempt in range(ATTEMPTS):
            try:
                row = measure()
            except DisturbedError as error:
                reason = str(error)
                continue
            return row if attempt == 0 else replace(row, measured=f"{row.measured}; at attempt {attempt + 1}")
        return replace(_nothing(fault), complaints=(f"{ATTEMPTS} attempts, each disturbed: {reason}",))

    return measured


def _nothing(fault: str) -> Row:
    return Row(fault=fault, how="processes", expected="-")


class Judged:
    """Checks of the surviving sides of a row."""

    def __init__(self, limits: Limits) -> None:
        self.wrong = Complaints()
        self._limits = limits
        self._took_s: list[float] = []
        self._findings: list[str] = []
        self._moved_m: float | None = None
        self._force_n: float | None = None

    def say(self, finding: str) -> None:
        """Add a finding to the measured text."""
        self._findings.append(finding)

    def never_held(self, *sides: Recorded, excused: bool = True) -> None:
        """Check that no side held, and that all are engaged at the end.

        Args:
            sides: All sides, which ended together.
            excused: True if a loop that woke too late right before the first hold makes the run invalid.

        Raises:
            DisturbedError: A loop woke too late.
        """
        # Each side has its own clock: times from the end are comparable.
        holds_s = [
            float(side.ticks.time_s[tick] - side.ticks.time_s[-1])
            for side in sides
            if (tick := side.ticks.first(HOLD)) is not None
        ]
        for side in sides if holds_s and excused else ():
            from_end_s = side.ticks.time_s - side.ticks.time_s[-1]
            near = (from_end_s > min(holds_s) - STALL_BEFORE_S) & (from_end_s <= min(holds_s))
            late_s = float(np.asarray(side.overshoot_s)[: len(near)][near].max(initial=0.0))
            if late_s > STALL_S:
                message = f"a loop woke {late_s:g} s late, and a side held"
                raise DisturbedError(message)
        for side in sides:
            tick = side.ticks.first(HOLD)
            self.wrong.check(tick is None, f"held because {side.reasons[tick or 0]!r}")
            self.wrong.check(side.ticks.last in {"engaged", "stale"}, f"ended in {side.ticks.last}")

    def silence(self, recorded: Recorded, reason: str = "peer is silent") -> None:
        """Check that the side held 20 ms after the last frame, for this reason."""
        ticks = recorded.ticks
        tick = ticks.first(HOLD)
        if tick is None:
            self.wrong.check(False, "never held")
            return
        age_s = float(ticks.age_s[tick])
        self._took_s.append(age_s)
        self.wrong.check(
            HOLD_S <= age_s <= self._limits.hold_s,
            f"held at a silence of {age_s:g} s, must be {HOLD_S:g} to {self._limits.hold_s:g} s",
        )
        self.wrong.check(
            recorded.reasons[tick] == reason, f"held because {recorded.reasons[tick]!r}, must be {reason!r}"
        )

    def woke(self, recorded: Recorded, expected: str) -> None:
        """Check that the side found its gap in the tick in which it woke."""
        ticks = recorded.ticks
        tick = ticks.first(HOLD)
        if tick is None:
            self.wrong.check(False, "the frozen side never held")
            return
        gap_s = float(ticks.time_s[tick] - ticks.time_s[tick - 1])
        reason = recorded.reasons[tick]
        self.wrong.check(reason == expected, f"woke and held because {reason!r}, must be {expected!r}")
        self.wrong.check(gap_s > 0.05, f"held after a gap of {gap_s:g} s")
        self.say(f"{NAMES[int(ticks.state[tick])]} in the tick it woke, after {gap_s:.2f} s")

    def master(self, recorded: Recorded) -> None:
        """Check that the force faded, and stayed away during the hold."""
        fade_s = recorded.ticks.fade_s()
        force_n = recorded.ticks.force_after_n(self._limits.fade_s)
        self._force_n = max(self._force_n or 0.0, force_n)
        self.wrong.check(fade_s <= self._limits.fade_s + 1e-9, f"force faded over {fade_s:g} s")
        self.wrong.check(force_n == 0.0, f"{force_n:g} N on the hand after the fade")
        first = recorded.ticks.first(HOLD)
        before = (
            0.0 if first is None else float(np.abs(recorded.ticks.output[max(first - 50, 0) : first]).max(initial=0.0))
        )
        self.say(f"force {before:.1f} N gone in {fade_s * 1e3:.0f} ms")

    def slave(self, recorded: Recorded) -> None:
        """Check that nothing moved during the hold, and that the command did not leap at the next engagement."""
        ticks = recorded.ticks
        moved_m = ticks.travelled()
        self._moved_m = max(self._moved_m or 0.0, moved_m)
        self.wrong.check(moved_m == 0.0, f"the command travelled {moved_m:g} m while it held")
        # The bound is 3 m/s, from the bounds of a command, for each tick that passed.
        step = np.abs(np.diff(ticks.output)) / np.diff(ticks.time_s)
        self.wrong.check(float(step.max(initial=0.0)) <= 3.0 + 1e-6, f"the command leapt at {step.max():g} m/s")

    def reached(self, recorded: Recorded, state: str) -> None:
        """Check the furthest state down the ladder."""
        self.wrong.check(recorded.ticks.worst == state, f"went to {recorded.ticks.worst}, must be {state}")

    def ended(self, recorded: Recorded, states: tuple[str, ...] = ("engaged", "stale")) -> None:
        """Check the state at the last tick."""
        self.wrong.check(
            recorded.ticks.last in states, f"ended in {recorded.ticks.last}, must be {' or '.join(states)}"
        )

    def row(self, fault: str, expected: str) -> Row:
        """Return the row of all checks."""
        took_s = max(self._took_s, default=None)
        return Row(
            fault=fault, how="processes", expected=expected, measured="; ".join(self._findings), reaction_s=took_s,
            limit_s=None if took_s is None else self._limits.hold_s, moved_m=self._moved_m, force_n=self._force_n,
            complaints=self.wrong.all(),
        )  # fmt: skip


def pair(stage: Stage) -> tuple[Process, Process]:
    """Start a slave, and a master that presses its wall."""
    slave = stage.slave()
    master = stage.master(slave.address)
    time.sleep(PRESSED_S)
    return slave, master


def killed_slave(limits: Limits) -> Row:
    """Measure a slave that is killed, and another in its place."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        address = slave.address
        slave.send(signal.SIGKILL)
        slave.end(None)
        time.sleep(0.3)
        other = stage.slave("other", listen=address)
        # A new handshake needs 2 s of silence and its repeats; nothing may engage.
        time.sleep(3.5)
        pressed_s = time.monotonic()
        master.send(signal.SIGUSR1)
        time.sleep(AGAIN_S)
        stage.end_together(master, other)
        since_s = time.monotonic() - pressed_s
        at_master, at_other = stage.ticks("master"), stage.ticks("other")
    undisturbed(at_master)
    judged = Judged(limits)
    judged.silence(at_master)
    judged.master(at_master)
    judged.reached(at_master, "stop")
    judged.slave(at_other)
    judged.ended(at_master.before_end())
    ticks = at_other.ticks
    coupled = np.flatnonzero(ticks.coupled)
    judged.wrong.check(coupled.size, "the new slave never engaged")
    if coupled.size:
        # Times are counted from the end, because the clocks of two processes have different zeros.
        before_end_s = float(ticks.time_s[-1] - ticks.time_s[coupled[0]])
        judged.wrong.check(
            before_end_s <= since_s, f"the new slave engaged {before_end_s - since_s:g} s before the press"
        )
        judged.wrong.check(ticks.output[coupled[0]] == ticks.output[0], "the new slave leapt")
        judged.say("new slave engaged by the press")
    return judged.row(KILLED_SLAVE, "hold, stop; engages by a press alone")


def killed_master(limits: Limits) -> Row:
    """Measure a master that is killed, and others after it."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        master.send(signal.SIGKILL)
        master.end(None)
        time.sleep(0.3)
        refused = stage.master(slave.address, "refused", "--patience-s", "2.5")
        said = refused.end(None)
        slave.send(signal.SIGUSR1)
        allowed = stage.master(slave.address, "allowed")
        time.sleep(PRESSED_S)
        allowed.end()
        slave.end()
        at_slave, at_allowed = stage.ticks("slave"), stage.ticks("allowed")
    undisturbed(at_slave)
    judged = Judged(limits)
    judged.silence(at_slave)
    judged.slave(at_slave)
    judged.reached(at_slave, "stop")
    judged.wrong.check("another master has the lease" in said, "the next master does not say why it was refused")
    judged.wrong.check(refused.process.returncode == 1, "the next master engaged without leave")
    judged.ended(at_allowed)
    judged.say("next master refused until SIGUSR1 at the slave, then engaged")
    return judged.row(KILLED_MASTER, "hold, stop; no other master without leave at the slave")


def restarted_master(limits: Limits) -> Row:
    """Measure a master that ends, and another after it."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        master.end()
        other = stage.master(slave.address, "other")
        time.sleep(PRESSED_S)
        other.end()
        slave.end()
        at_slave, at_other = stage.ticks("slave"), stage.ticks("other")
    undisturbed(at_slave)
    judged = Judged(limits)
    judged.wrong.check(at_slave.ticks.first(HOLD) is None, "an orderly end was met by a hold")
    judged.wrong.check(_left(at_slave) == "peer has ended", f"the slave left because {_left(at_slave)!r}")
    judged.slave(at_slave)
    coupled = at_slave.ticks.coupled
    begun = np.flatnonzero(coupled[1:] & ~coupled[:-1]) + 1
    judged.wrong.check(begun.size == 2, f"engaged {begun.size} times, must be 2")
    ended = np.flatnonzero(~coupled[1:] & coupled[:-1]) + 1
    between = at_slave.ticks.output[ended[0] : begun[-1]] if begun.size == 2 and ended.size else np.zeros(1)
    judged.wrong.check(np.ptp(between) == 0.0, f"the command travelled {np.ptp(between):g} m between the two")
    judged.ended(at_other)
    judged.say(f"slave left because {_left(at_slave)!r}")
    return judged.row(RESTARTED_MASTER, "an end, and no hold; lease released; engages by the press of the next")


def _left(recorded: Recorded) -> str:
    coupled = recorded.ticks.coupled
    left = np.flatnonzero(~coupled[1:] & coupled[:-1]) + 1
    return recorded.reasons[int(left[0])] if left.size else "never"


def frozen(who: str, length_s: float, limits: Limits) -> Row:
    """Measure a SIGSTOP for a time."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        (slave if who == "slave" else master).frozen(length_s)
        # A side that stopped for 3 s has lost its session: the handshake comes first.
        time.sleep(0.5 if length_s < 2.0 else 3.0)
        master.send(signal.SIGUSR1)
        time.sleep(AGAIN_S)
        stage.end_together(slave, master)
        sides = {"slave": stage.ticks("slave").before_end(), "master": stage.ticks("master").before_end()}
    for side in sides.values():
        undisturbed(side)
    judged = Judged(limits)
    other = "master" if who == "slave" else "slave"
    judged.silence(sides[other])
    judged.reached(sides[other], "hold" if length_s < 0.2 else "stop")
    judged.woke(sides[who], "own loop was late" if length_s < 0.2 else "no working peer for too long")
    judged.master(sides["master"])
    judged.slave(sides["slave"])
    for side in sides.values():
        judged.ended(side)
    worst = NAMES[HOLD] if length_s < 0.2 else NAMES[STOP]
    return judged.row(stopped(who, length_s), f"both {worst}, itself in the tick it wakes; a press engages")


def stopped(who: str, length_s: float) -> str:
    """Return the name of the row."""
    return f"{who}: SIGSTOP " + (f"{length_s * 1e3:.0f} ms" if length_s < 1.0 else f"{length_s:g} s")


def wrong_key(limits: Limits) -> Row:
    """Measure a master with another key."""
    with Stage.set() as stage:
        write_key(stage.path("other.key"))
        slave = stage.slave()
        master = stage.master(slave.address, "master", "--patience-s", "2", key=stage.path("other.key"))
        said = master.end(None)
        slave.end()
        at_slave, report = stage.ticks("slave"), stage.report("slave")
    judged = Judged(limits)
    judged.slave(at_slave)
    judged.wrong.check(set(at_slave.ticks.state) == {0}, "the slave left disengaged")
    judged.wrong.check(np.ptp(at_slave.ticks.output) == 0.0, "the command travelled")
    judged.wrong.check(master.process.returncode == 1 and "no slave answered" in said, f"the master said {said!r}")
    judged.wrong.check(
        report["sent"] == 0 and sum(report["rejections"].values()) >= 2, f"slave: {report['rejections']}"
    )
    judged.say(f"slave: {causes(report['rejections'])}, nothing sent")
    return judged.row(WRONG_KEY, "never answered, counted, slave disengaged")


def second_master(limits: Limits) -> Row:
    """Measure a second master beside a live one."""
    with Stage.set() as stage:
        slave, master = pair(stage)
        begun_s = time.monotonic()
        second = stage.master(slave.address, "second", "--patience-s", "1.5")
        said = second.end(None)
        took_s = time.monotonic() - begun_s
        stage.end_together(slave, master)
        sides = [stage.ticks("slave").before_end(), stage.ticks("master").before_end()]
    judged = Judged(limits)
    judged.never_held(*sides)
    judged.slave(sides[0])
    judged.wrong.check("refused: another master has the lease" in said, f"the second master said {said!r}")
    judged.wrong.check(second.process.returncode == 1, "the second master did not fail")
    judged.say(f"refused and told so; it gave up {took_s:.1f} s after its start; the first never held")
    return judged.row(SECOND_MASTER, "refused and told so; the first goes on")


def rows(limits: Limits | None = None) -> dict[str, Callable[[], Row]]:
    """Return all measurements by name, to be run one after the other."""
    bounds = limits or Limits()
    measures: dict[str, Callable[[Limits], Row]] = {
        KILLED_SLAVE: killed_slave,
        KILLED_MASTER: killed_master,
        RESTARTED_MASTER: restarted_master,
        WRONG_KEY: wrong_key,
        SECOND_MASTER: second_master,
    }
    for length_s in (0.1, 3.0):
        for who in ("slave", "master"):
            measures[stopped(who, length_s)] = partial(frozen, who, length_s)
    return {fault: again(partial(measure, bounds), fault) for fault, measure in measures.items()}
