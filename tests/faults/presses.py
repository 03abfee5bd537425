"""Presses of the clutch over a broken link: no press couples a hand later than its moment."""

import signal
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from tests.faults.processes import Judged, Limits, again, undisturbed
from tests.faults.rows import Row
from tests.faults.running import AGAIN_S, PRESSED_S, Process, Recorded, Stage

from haptether.netsim import ask_control

DELAY_S = 0.03
"""One-way delay in s: the two sides disagree for this long."""
EXPIRED_S = 6.0
"""Time in s beyond the 5 s for which a press counts, docs/ladder.md."""
WATCHED_S = 3.5
"""Time in s after the link is back: a new handshake after silence takes 2 s and its repeats."""
LATE_SLAVE = "slave: started 6 s after its master"


def cut_name(after_s: float, restarted: bool) -> str:
    """Return the row name of a link that is cut so long after a press."""
    slave = ", slave started anew" if restarted else ""
    return f"link: cut {after_s * 1e3:.0f} ms after a press, for {EXPIRED_S:g} s{slave}"


def _coupled(recorded: Recorded, from_s: float, to_s: float) -> bool:
    """Return true if it was coupled between two times in s, relative to the last tick."""
    since_end_s = recorded.ticks.time_s - recorded.ticks.time_s[-1]
    between = (since_end_s >= from_s) & (since_end_s < to_s)
    return bool(np.any(recorded.ticks.coupled & between))


def _judge(name: str, at_master: Recorded, at_slave: Recorded, watched_s: tuple[float, float]) -> Row:
    judged = Judged(Limits())
    for who, side in (("master", at_master), ("slave", at_slave)):
        judged.wrong.check(not _coupled(side, *watched_s), f"the {who} coupled without a new press")
        judged.wrong.check(side.before_end().ticks.last == "engaged", f"a new press did not engage the {who}")
    force_n = float(np.abs(at_master.ticks.output[_of(at_master, *watched_s)]).max(initial=0.0))
    judged.wrong.check(force_n == 0.0, f"{force_n:g} N on the hand")
    judged.slave(at_slave)
    judged.say("nothing until a new press, which engaged")
    return judged.row(name, "not coupled by the press from before; a new one engages")


def _of(recorded: Recorded, from_s: float, to_s: float) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    since_end_s = recorded.ticks.time_s - recorded.ticks.time_s[-1]
    within: np.ndarray[tuple[int], np.dtype[np.bool_]] = (since_end_s >= from_s) & (since_end_s < to_s)
    return within


def late_slave() -> Row:
    """Measure a master whose slave comes once its start has expired as a press."""
    with Stage.set() as stage:
        # The first slave provides the address for the master.
        first = stage.slave("first")
        address = first.address
        first.end()
        master = stage.master(address, "master", "--patience-s", "60")
        time.sleep(EXPIRED_S)
        slave = stage.slave(listen=address)
        return _watched(stage, master, slave, LATE_SLAVE, delay_s=0.0)


def _pressed(stage: Stage, slave: Process, *options: str) -> tuple[Process, Process]:
    """Start a link and a master, hold them once with the link, and press; return both."""
    link = Process(
        "netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", slave.address, "--delay-s", f"{DELAY_S}",
        "--max-error-s", "1", *options,
    )  # fmt: skip
    stage.processes.append(link)
    master = stage.master(link.headline.split()[3].rstrip(","))
    time.sleep(PRESSED_S + 4.0 * DELAY_S)
    link.frozen(0.3)
    time.sleep(1.0)
    master.send(signal.SIGUSR1)
    return link, master


def _watched(stage: Stage, master: Process, slave: Process, name: str, delay_s: float = 4.0 * DELAY_S) -> Row:
    """Watch both sides without a press, then with one; return the row."""
    begun_s = time.monotonic()
    time.sleep(WATCHED_S)
    master.send(signal.SIGUSR1)
    pressed_s = time.monotonic()
    time.sleep(AGAIN_S + delay_s)
    end_s = time.monotonic()
    stage.end_together(master, slave)
    at_master = stage.ticks("master")
    if delay_s:
        undisturbed(at_master)
    return _judge(name, at_master, stage.ticks("slave"), (begun_s - end_s, pressed_s - end_s))


def cut(after_s: float, restarted: bool) -> Row:
    """Measure a link that is cut while a press waits for its answer, and comes back once the press has expired."""
    with Stage.set() as stage:
        slave = stage.slave("before" if restarted else "slave")
        link, master = _pressed(stage, slave)
        time.sleep(after_s)
        # Datagrams in transit are kept, and arrive when the link is back.
        link.send(signal.SIGSTOP)
        if restarted:
            address = slave.address
            slave.send(signal.SIGKILL)
            slave.end(None)
            slave = stage.slave(listen=address)
        time.sleep(EXPIRED_S)
        link.send(signal.SIGCONT)
        return _watched(stage, master, slave, cut_name(after_s, restarted))


def deaf_name(back_s: float) -> str:
    """Return the row name of a direction that is cut just before a press, for so long."""
    return f"link: master to slave cut before a press leaves, back {back_s:g} s after it"


def deaf(back_s: float) -> Row:
    """Measure a slave in STOP that hears the release and no press; its frames arrive; the direction returns in time."""
    with Stage.set() as stage:
        slave = stage.slave()
        control = str(stage.path("netsim.ctl"))
        _, master = _pressed(stage, slave, "--control", control)
        # The signal opens the clutch for 0.1 s and then presses.
        time.sleep(0.07)
        ask_control(control, {"forward": {"loss": 1.0}})
        time.sleep(back_s + 0.03)
        ask_control(control, {"forward": {"loss": 0.0}})
        return _watched(stage, master, slave, deaf_name(back_s))


def rows() -> dict[str, Callable[[], Row]]:
    """Return all measurements by name, to be run one after the other."""
    measures: dict[str, Callable[[], Row]] = {LATE_SLAVE: late_slave}
    for after_s in (0.085, 0.13, 0.16):
        measures[cut_name(after_s, False)] = partial(cut, after_s, False)
    measures[cut_name(0.13, True)] = partial(cut, 0.13, True)
    for back_s in (1.0, 3.4, 4.6):
        measures[deaf_name(back_s)] = partial(deaf, back_s)
    return {name: again(measure, name) for name, measure in measures.items()}
