"""Network faults, in virtual time and in a secure session: the same on every machine."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from tests.faults.rows import Complaints, Row
from tests.faults.signals import Ticks
from tests.scene.two_sides import reports, two_sides

from haptether.bridge import LoopReport, simulate
from haptether.netsim import (
    Attack,
    BitFlip,
    ByteRange,
    Drop,
    Forge,
    LinkSettings,
    Mirror,
    Once,
    Outage,
    Replay,
    SequenceLead,
    Target,
)

PERIOD_S = 1e-3
DELAY_S = 0.005
"""One-way delay of both directions, in s: a side learns the other's state only after it."""
FAULT_S = 2.0
"""Time of the fault, in s: mid-way of a stroke, so that a motion that continues shows."""
STALE_S, HOLD_S, STOP_S, FADE_S = 0.005, 0.020, 0.200, 0.075
"""Times of docs/ladder.md, beyond the expected age, in s."""
AGAIN_S = 3.0
"""Time after the end of a fault, in s: the simulated person presses half a second after both sides are ready."""
STROKE_S = 0.4
CLEAN = LinkSettings(delay_s=DELAY_S)


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Both sides of a run."""

    master: Ticks
    slave: Ticks
    at_master: LoopReport
    at_slave: LoopReport


def run(forward: LinkSettings, backward: LinkSettings, duration_s: float) -> Pair:
    """Run a hand that strokes a wall to and fro, 15 mm in 0.4 s; the person presses again after each hold."""
    strokes = [{"duration_s": STROKE_S, "end": (-0.045, -0.03)[n % 2]} for n in range(round(duration_s / STROKE_S))]
    scene = two_sides(
        run={"duration_s": duration_s, "seed": 7},
        operator={"legs": [{"duration_s": 1.0, "end": -0.03}, *strokes], "clutch": "auto"},
        link={"forward": forward, "backward": backward},
        security={},
        safety={"controllers": ["wsc"], "hold_off_s": 0.1, "release_ramp_s": 0.2},
    )
    done = simulate(scene)
    (master, slave), (at_master, at_slave) = Ticks.of_run(done), reports(done)
    return Pair(master=master, slave=slave, at_master=at_master, at_slave=at_slave)


@cache
def undisturbed(duration_s: float) -> Pair:
    """Run the same without a fault."""
    return run(CLEAN, CLEAN, duration_s)


def outage(name: str, length_s: float, *, forward: LinkSettings, backward: LinkSettings, one_way: bool = False) -> Row:
    """Drop frames for a while: check how far and how soon the ladder leads down, and that a press leads up again."""
    pair = run(forward, backward, FAULT_S + length_s + AGAIN_S)
    worst = "stale" if length_s < HOLD_S else "hold" if length_s < STOP_S else "stop"
    holds = worst != "stale"
    wrong = Complaints()
    # The first missing frame is due now.
    missed_s = FAULT_S + DELAY_S
    disturbed_s = missed_s + length_s + DELAY_S
    sides = {"master": pair.master.between(missed_s), "slave": pair.slave.between(missed_s)}
    reached = {side: ticks.between(missed_s, disturbed_s).worst for side, ticks in sides.items()}
    if one_way:
        # The side that still receives follows as long as it gets commands.
        wrong.check(worst in reached.values(), f"went to {reached}, must reach {worst}")
        wrong.check(not holds or not {"engaged", "stale"} & set(reached.values()), f"went to {reached}: both must hold")
    else:
        wrong.check(set(reached.values()) == {worst}, f"went to {reached}, must be {worst}")
    row = Row(
        fault=name,
        how="virtual",
        expected=f"{worst}, both sides; a press engages",
        measured=f"{reached['master']}, {reached['slave']}",
    )
    if not holds:
        wrong.check(not any(ticks.held.any() for ticks in sides.values()), "a side held")
        return finished(row, wrong, pair)
    took_s = [ticks.held_after_s(missed_s) for ticks in sides.values()]
    # A side that still receives learns of the outage a one-way delay later; add one tick for each of the two.
    limit_s = HOLD_S + 2 * PERIOD_S + (DELAY_S + PERIOD_S if one_way else 0.0)
    wrong.check(max(took_s) <= limit_s + 1e-9, f"held after {max(took_s):g} s, must be {limit_s:g} s at most")
    wrong.check(min(took_s) >= HOLD_S - 1e-9, f"held after {min(took_s):g} s: before its time")
    fade_s = pair.master.fade_s()
    wrong.check(fade_s <= FADE_S + PERIOD_S + 1e-9, f"force faded over {fade_s:g} s, must be {FADE_S:g} s at most")
    return finished(row, wrong, pair, reaction_s=max(took_s), limit_s=limit_s, fade_s=fade_s)


def finished(
    row: Row, wrong: Complaints, pair: Pair, *, reaction_s: float | None = None, limit_s: float | None = None,
    fade_s: float | None = None,
) -> Row:  # fmt: skip
    """Build a row from the checks of each run that leads down the ladder."""
    moved_m = pair.slave.travelled()
    force_n = pair.master.force_after_n(FADE_S + PERIOD_S)
    wrong.check(moved_m == 0.0, f"the command travelled {moved_m:g} m while the slave held")
    wrong.check(force_n == 0.0, f"{force_n:g} N on the hand after the fade")
    ends = (pair.master.last, pair.slave.last)
    wrong.check(ends == ("engaged", "engaged"), f"ended in {ends}, must have engaged again")
    faded = "" if fade_s is None else f"; force gone in {fade_s * 1e3:.0f} ms"
    return Row(
        fault=row.fault, how=row.how, expected=row.expected, measured=f"{row.measured}{faded}; ends {ends[0]}",
        reaction_s=reaction_s, limit_s=limit_s, moved_m=moved_m, force_n=force_n, complaints=wrong.all(),
    )  # fmt: skip


def stray(name: str, forward: LinkSettings, *, min_refused: int, held_back_s: float = 0.0, cause: str = "") -> Row:
    """Send datagrams that must have no effect, or delay valid ones by `held_back_s` only."""
    duration_s = 6.0
    pair, alone = run(forward, CLEAN, duration_s), undisturbed(duration_s)
    moved_m = float(np.abs(pair.slave.output - alone.slave.output).max())
    extra_n = float(np.abs(pair.master.output - alone.master.output).max())
    wrong = Complaints()
    # A delayed follower lags by the motion of that time; the path itself reacts to the force, hence the factor 2.
    fastest = float(np.abs(np.diff(alone.slave.output)).max()) / PERIOD_S
    allowed_m = 2.0 * fastest * held_back_s
    wrong.check(moved_m <= allowed_m, f"the command was {moved_m:g} m off, must be {allowed_m:g} m at most")
    wrong.check(held_back_s > 0.0 or extra_n == 0.0, f"the force was {extra_n:g} N off, must be the same")
    holds = pair.at_master.holds + pair.at_slave.holds
    wrong.check(holds == 0, f"{holds} holds, must be none")
    counted = {**pair.at_slave.rejections}
    for key, count in pair.at_master.rejections.items():
        counted[key] = counted.get(key, 0) + count
    if cause == "late":
        counted = {"late": pair.at_slave.link.late}
    refused = sum(counted.values())
    wrong.check(refused >= min_refused, f"{counted}: must be {min_refused} at least")
    summary = causes(counted)
    expected = "refused and counted, nothing changes" if held_back_s == 0.0 else "counted, not obeyed; no hold"
    return Row(
        fault=name, how="virtual", expected=expected, measured=f"{summary}; no hold" if holds == 0 else summary,
        moved_m=moved_m, force_n=extra_n if held_back_s == 0.0 else None, complaints=wrong.all(),
    )  # fmt: skip


def causes(counted: dict[str, int], max_causes: int = 2) -> str:
    """Return the most frequent causes of refusals in few words, and the count of the others."""
    ordered = sorted(counted.items(), key=lambda item: -item[1])
    others = sum(count for _, count in ordered[max_causes:])
    parts = [f"{count} {cause.split(':')[0]}" for cause, count in ordered[:max_causes]]
    return ", ".join([*parts, f"{others} for other causes"] if others else parts)


def attacked(*attacks: Attack) -> LinkSettings:
    """Return the clean network with attackers."""
    return LinkSettings(delay_s=DELAY_S, attacks=attacks)


def without(length_s: float) -> LinkSettings:
    """Return the clean network with an outage."""
    return LinkSettings(delay_s=DELAY_S, outages=(Outage(times=Once(at_s=FAULT_S, duration_s=length_s)),))


def outages() -> Iterator[Callable[[], Row]]:
    """Yield rows of times without frames."""
    for milliseconds in (10, 30, 100, 1_000, 10_000):
        length_s = milliseconds * 1e-3
        dead = without(length_s)
        yield partial(outage, f"outage {milliseconds} ms", length_s, forward=dead, backward=dead)
    for milliseconds in (30, 1_000):
        length_s = milliseconds * 1e-3
        dead = without(length_s)
        one_way = partial(outage, length_s=length_s, one_way=True)
        yield partial(one_way, f"one-way outage {milliseconds} ms, to the slave", forward=dead, backward=CLEAN)
        yield partial(one_way, f"one-way outage {milliseconds} ms, to the master", forward=CLEAN, backward=dead)
    burst = attacked(Attack(action=Drop(), target=Target(from_s=FAULT_S, until_s=FAULT_S + 40 * PERIOD_S)))
    yield partial(outage, "40 packets lost in a row, both ways", 0.040, forward=burst, backward=burst)
    queue = LinkSettings(delay_s=DELAY_S, outages=(Outage(times=Once(at_s=FAULT_S, duration_s=0.04), effect="hold"),))
    yield partial(outage, "40 packets late, then all at once", 0.040, forward=queue, backward=queue)


def strays() -> Iterator[Callable[[], Row]]:
    """Yield rows of misplaced datagrams and of datagrams without the key, with 6000 valid ones each."""
    reorder = LinkSettings(delay_s=DELAY_S, reorder=0.2, reorder_hold_s=0.003)
    yield partial(stray, "reorder: a fifth is held for 3 ms", reorder, min_refused=500, held_back_s=0.008, cause="late")
    twice = LinkSettings(delay_s=DELAY_S, duplicate=0.5, duplicate_gap_s=0.002)
    yield partial(stray, "duplicate: every second one", twice, min_refused=2_500)
    again = attacked(Attack(action=Replay(after_s=0.5)))
    yield partial(stray, "replay of all, 0.5 s later", again, min_refused=5_000)
    long_ago = attacked(Attack(action=Replay(after_s=3.0)))
    yield partial(stray, "replay of all, 3 s later: beyond the window", long_ago, min_refused=2_500)
    mirror = attacked(Attack(action=Mirror()))
    yield partial(stray, "all sent back to their sender", mirror, min_refused=5_500)
    forged = attacked(Attack(action=Forge(keep_bytes=24)))
    yield partial(stray, "forged: true header, random rest", forged, min_refused=5_500)
    ahead = attacked(Attack(action=SequenceLead(lead=1_000_000, offset=16)))
    yield partial(stray, "forged: counter a million ahead", ahead, min_refused=5_500)
    fuzz = attacked(*(Attack(action=Forge(keep_bytes=keep)) for keep in (0, 2, 3, 4, 8, 16)))
    yield partial(stray, "header fuzz: random from byte 0, 2, 3, 4, 8, 16 on", fuzz, min_refused=30_000)
    flip = attacked(
        Attack(action=BitFlip(bits=1, within=ByteRange(start=0, end=190)), target=Target(from_s=0.5, every=3))
    )
    yield partial(stray, "a bit flipped in every third", flip, min_refused=1_750, held_back_s=0.003)
    head = attacked(
        Attack(action=BitFlip(bits=3, within=ByteRange(start=0, end=24)), target=Target(from_s=0.5, every=3))
    )
    yield partial(stray, "three bits flipped in every third header", head, min_refused=1_750, held_back_s=0.003)
    cut = LinkSettings(delay_s=DELAY_S, truncate=0.1, truncate_bytes=100)
    yield partial(stray, "a tenth cut short", cut, min_refused=450, held_back_s=0.006)


def rows() -> list[Callable[[], Row]]:
    """Return all rows, to run one after the other."""
    return [*outages(), *strays()]
