"""Endpoints with wrong clocks: the visible effects in a run, and the forbidden ones."""

import numpy as np
import pytest
from msgspec.structs import replace

from haptether.bridge import Run, simulate

CLOCKS = ("link.master_clock", "link.slave_clock")


def ladder_changes(run: Run, side: str) -> list[tuple[float, str]]:
    """Return the times and states of the ladder changes of a side."""
    states = {"engaged", "hold", "stop", "fault"}
    events = [event for event in run.events if event.detail.startswith(f"{side}: ")]
    return [(event.time_s, event.kind) for event in events if event.kind in states]


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("offset_s", [-4e9, -0.5, 0.0, 1.5e-9, 1e6, 4e9])
def test_an_offset_changes_not_a_byte(clock: str, offset_s: float) -> None:
    right = simulate("remote_push")
    wrong = simulate("remote_push", overrides=[f"{clock}.offset_s={offset_s}"])
    assert right.events == wrong.events
    assert replace(right.metrics, wall_time_s=0.0) == replace(wrong.metrics, wall_time_s=0.0)
    for name, values in right.signals.items():
        assert values.tobytes() == wrong.signals[name].tobytes(), name


LONG = [
    *("run.duration_s=100", "operator.release.at_s=99", "environment.pushers.0.at_s=50", "record.every=1"),
    *("link.forward.loss=0", "link.backward.loss=0", "link.forward.jitter_s=0", "link.backward.jitter_s=0"),
]


@pytest.mark.parametrize("drift_ppm", [-100.0, 100.0])
@pytest.mark.parametrize("side", ["master", "slave"])
def test_drift_shows_in_the_period_and_not_in_the_coupling(side: str, drift_ppm: float) -> None:
    run = simulate("remote_push", overrides=[*LONG, f"link.{side}_clock.drift_ppm={drift_ppm}"])
    assert [kind for _, kind in ladder_changes(run, "master")] == ["engaged"]
    assert [kind for _, kind in ladder_changes(run, "slave")] == ["engaged"]

    # Recorded times are true ones: a fast clock ticks after 1 ms / (1 + drift), to the ns.
    times = run.signals["time_s" if side == "master" else "slave_time_s"]
    expected = np.arange(len(times)) * 1e-3 / (1.0 + drift_ppm * 1e-6)
    np.testing.assert_allclose(times, expected, rtol=0.0, atol=1.1e-9)
    assert times[-1] == pytest.approx(100.0, abs=1.1e-3)

    # The delay is 50 ms, and a tick samples it: up to a tick later, for any difference of the clocks.
    age = run.signals["age_s"][200:]
    assert age.min() >= 0.0
    assert age.max() <= 2e-3 + 1e-6


@pytest.mark.parametrize(
    ("step_s", "kinds", "peer_stops"),
    [
        (0.015, [], False),
        (0.1, ["hold", "engaged"], False),
        # More than the ladder's 200 ms pass in one tick: HOLD before the tick is STOP after it. The simulated person
        # then releases the clutch and presses it.
        (1.0, ["stop", "engaged"], True),
    ],
)
@pytest.mark.parametrize("side", ["master", "slave"])
def test_a_step_forward_leads_to_what_the_ladder_does_for_a_late_loop(
    side: str, step_s: float, kinds: list[str], peer_stops: bool
) -> None:
    step = [f"link.{side}_clock.step_s={step_s}", f"link.{side}_clock.step_at_s=1.0"]
    clean = ["link.forward.loss=0", "link.backward.loss=0", "link.forward.jitter_s=0", "link.backward.jitter_s=0"]
    run = simulate("remote_push", overrides=[*clean, *step])
    changes = [(time_s, kind) for time_s, kind in ladder_changes(run, side) if time_s > 0.9]
    assert [kind for _, kind in changes] == kinds
    peer = "slave" if side == "master" else "master"
    if peer_stops:
        assert "stop" in [kind for _, kind in ladder_changes(run, peer)]
    for time_s, _ in changes[:1]:
        assert time_s == pytest.approx(1.0, abs=1.1e-3)


def test_a_clock_that_is_set_back_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\[link.slave_clock\] step_s = -1: must be 0 or more: a monotonic clock"):
        simulate("remote_push", overrides=["link.slave_clock.step_s=-1", "link.slave_clock.step_at_s=1"])
