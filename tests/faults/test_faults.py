"""The fault suite in short, and a proof that its rows can fail."""

from collections.abc import Callable

import numpy as np
import pytest
from tests.faults import (
    clocks,
    coupled,
    drivers,
    grippers,
    hostile,
    machine,
    numbers,
    poses,
    processes,
    servos,
    virtual,
)
from tests.faults.rows import Row
from tests.faults.running import DEFAULT_SCENE, Process, Recorded, Stage
from tests.faults.signals import ENGAGED, HOLD, STOP, Ticks
from tests.ur.stalls import anew_after_stalls

pytestmark = pytest.mark.live

LOOSE = processes.Limits(hold_s=0.15, fade_s=0.2)
"""Limits for single runs beside other work."""


def judge(row: Row) -> None:
    if row.verdict == "n/a":
        pytest.skip(row.measured)
    assert row.verdict == "ok", f"{row.fault}: {'; '.join(row.complaints)}"


def names(rows: list[Callable[[], Row]]) -> list[str]:
    return [f"{n}" for n in range(len(rows))]


VIRTUAL = [*virtual.rows(), *clocks.rows()]


@pytest.mark.parametrize("measure", VIRTUAL, ids=names(VIRTUAL))
def test_in_virtual_time(measure: Callable[[], Row]) -> None:
    judge(measure())


NUMBERS = numbers.rows()


@pytest.mark.parametrize("measure", NUMBERS, ids=names(NUMBERS))
def test_numbers_that_cannot_be(measure: Callable[[], Row]) -> None:
    judge(measure())


DRIVERS = drivers.rows(LOOSE.hold_s)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("measure", DRIVERS, ids=names(DRIVERS))
@anew_after_stalls
def test_drivers_in_python_that_fail(measure: Callable[[], Row]) -> None:
    judge(measure())


GRIPPERS = grippers.rows(2.0)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("measure", GRIPPERS, ids=names(GRIPPERS))
def test_grippers_that_fail(measure: Callable[[], Row]) -> None:
    judge(measure())


SERVOS = servos.rows(patient=True)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("measure", SERVOS, ids=names(SERVOS))
@anew_after_stalls
def test_servos_that_fail(measure: Callable[[], Row]) -> None:
    judge(measure())


POSES = poses.rows(LOOSE.hold_s)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("measure", POSES, ids=names(POSES))
def test_poses_and_buttons_that_cannot_be(measure: Callable[[], Row]) -> None:
    judge(measure())


SELECTED = {
    name: measure
    for rows in (processes.rows(LOOSE), machine.rows(LOOSE), hostile.rows(LOOSE))
    for name, measure in rows.items()
    if name in {processes.KILLED_MASTER, processes.stopped("slave", 0.1), machine.FULL_DISK, hostile.REPLAYED}
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SELECTED)
def test_with_processes(name: str) -> None:
    judge(SELECTED[name]())


COUPLED = coupled.rows(LOOSE)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", COUPLED)
@anew_after_stalls
def test_under_other_couplings(name: str) -> None:
    row = COUPLED[name]()
    judge(row)
    assert name.startswith(f"{row.coupling}, ")
    assert Stage.overrides == ()


def test_both_sides_of_a_row_start_with_its_coupling() -> None:
    seen = []

    def measure() -> Row:
        seen.append(Stage.scene_options())
        return Row(fault="a", how="processes", expected="b")

    assert coupled.under("wave", measure)().coupling == "wave"
    assert seen == [["--scene", DEFAULT_SCENE, "--set", "coupling.kind=wave"]]
    assert Stage.scene_options() == []


def ticks(state: list[int], output: list[float]) -> Ticks:
    count = len(state)
    return Ticks(
        time_s=np.arange(count, dtype=np.float64) * 1e-3,
        state=np.array(state),
        age_s=np.zeros(count),
        output=np.array(output, dtype=np.float64),
    )


def test_what_moves_in_hold_shows() -> None:
    still = ticks([ENGAGED, HOLD, HOLD, STOP, ENGAGED], [0.0, 1.0, 1.0, 1.0, 2.0])
    assert still.travelled() == 0.0
    assert ticks([ENGAGED, HOLD, HOLD, STOP, ENGAGED], [0.0, 1.0, 1.5, 1.25, 2.0]).travelled() == 0.75


def test_a_force_that_stays_shows() -> None:
    fading = ticks([ENGAGED, HOLD, HOLD, HOLD, ENGAGED], [3.0, 2.0, 1.0, 0.0, 0.5])
    assert fading.fade_s() == pytest.approx(2e-3)
    assert fading.force_after_n(1.5e-3) == 0.0
    staying = ticks([ENGAGED, HOLD, HOLD, STOP, STOP], [3.0, 2.0, 1.0, 1.0, 1.0])
    assert staying.fade_s() == np.inf
    assert staying.force_after_n(1.5e-3) == 1.0


def test_a_row_says_what_was_not_as_expected() -> None:
    """Report an outage as shorter than it is."""
    dead = virtual.without(0.1)
    row = virtual.outage("reported as 10 ms", 0.010, forward=dead, backward=dead)
    assert row.verdict == "FAILED"
    assert "a side held" in row.complaints
    assert row.as_json()["verdict"] == "FAILED"


def test_datagrams_that_change_something_show() -> None:
    from haptether.netsim import LinkSettings

    row = virtual.stray("later by 2 ms", LinkSettings(delay_s=virtual.DELAY_S + 0.002), min_refused=0)
    assert any("m off" in complaint for complaint in row.complaints)


def test_a_run_that_is_disturbed_is_measured_anew() -> None:
    calls = 0

    def measure() -> Row:
        nonlocal calls
        calls += 1
        if calls < 3:
            raise processes.DisturbedError("held")
        return Row(fault="a", how="processes", expected="b", measured="c")

    row = processes.again(measure, "a")()
    assert (row.verdict, row.measured) == ("ok", "c; at attempt 3")

    def never() -> Row:
        raise processes.DisturbedError("held")

    row = processes.again(never, "a")()
    assert row.verdict == "FAILED"
    assert row.complaints == ("3 attempts, each disturbed: held",)


def test_a_stage_leaves_no_pipe_open_of_a_process_that_has_ended_by_itself() -> None:
    with Stage.set() as stage:
        process = Process("list")
        stage.processes.append(process)
        process.process.wait()
    assert process.process.stderr is not None
    assert process.process.stderr.closed


@pytest.mark.parametrize("late_s", [0.0, 0.003, 0.03])
@pytest.mark.parametrize("stalled_at", [400, 480, 520])
@pytest.mark.parametrize("held_side", [0, 1, None])
def test_a_hold_is_the_machines_only_after_a_loop_woke_late(
    late_s: float, stalled_at: int, held_side: "int | None"
) -> None:
    def side(held: bool, began_s: float) -> Recorded:
        state = np.full(1000, ENGAGED)
        state[500:] = HOLD if held else ENGAGED
        times = np.arange(1000, dtype=np.float64) * 1e-3 + began_s
        ticks = Ticks(time_s=times.astype(np.float64), state=state, age_s=np.zeros(1000), output=np.zeros(1000))
        overshoot_s = [0.0] * 1000
        overshoot_s[stalled_at] = late_s
        return Recorded(ticks=ticks, reasons=["peer is silent"] * 1000, overshoot_s=overshoot_s)

    sides = [side(held_side == 0, 3.0), side(held_side == 1, 70.0)]
    judged = processes.Judged(processes.Limits())
    if held_side is not None and late_s > 0.01 and stalled_at < 500:
        with pytest.raises(processes.DisturbedError, match=r"woke 0\.03 s late"):
            judged.never_held(*sides)
    else:
        judged.never_held(*sides)
        assert (judged.row("a", "b").verdict == "FAILED") == (held_side is not None)
    judged = processes.Judged(processes.Limits())
    judged.never_held(*sides, excused=False)
    assert (judged.row("a", "b").verdict == "FAILED") == (held_side is not None)
