"""A running scene, described sample by sample, against the same run after its end."""

from typing import Any

import numpy as np
import pytest
from tests.view.shown import shown

from haptether.bridge import (
    Run,
    TelemetryChange,
    TelemetryEnd,
    TelemetryHello,
    TelemetryLost,
    TelemetrySample,
    TelemetrySignal,
    ladder_state_name,
)
from haptether.view import LiveDescription
from haptether.view.scene3d.history import History

MASTER = ("position", "velocity", "hand_force", "device_force", "safety_force", "windowed_energy_j", "tripped", "state")
SLAVE = ("slave_position", "slave_command", "environment_force", "slave_state")
KINDS = {"windowed_energy_j": "number", "tripped": "bits", "state": "name"}
SLAVE_LATER_S = 3.0
"""Lead of the slave's loop, in s: it starts earlier, so that its times are larger."""


def hello(run: Run, side: str) -> TelemetryHello:
    signals = []
    for name in MASTER if side == "master" else SLAVE:
        own = name.removeprefix("slave_")
        axes = 1 if run.signals[name].ndim == 1 else run.signals[name].shape[1]
        signals.append(TelemetrySignal(name=own, kind=KINDS.get(own, "axes"), size=axes, meaning=""))
    if side == "master":
        signals.append(TelemetrySignal(name="true_position", kind="axes", size=signals[0].size, meaning=""))
        signals.append(TelemetrySignal(name="peer_state", kind="name", size=1, meaning=""))
    return TelemetryHello(schema=1, side=side, security="secure", scene=run.settings, signals=signals)


def value(run: Run, name: str, at: int) -> Any:  # noqa: ANN401  # depends on the kind of the signal
    given = run.signals[name][at]
    match KINDS.get(name.removeprefix("slave_"), "axes"):
        case "axes":
            return [[float(one) if np.isfinite(one) else None] * 3 for one in np.atleast_1d(given)]
        case "number":
            return [float(given)] * 3 if np.isfinite(given) else [None] * 3
        case "bits":
            return [int(given), int(given)]
        case _:
            return ladder_state_name(int(given))


def sample(run: Run, side: str, time_s: float) -> TelemetrySample:
    of_side = "time_s" if side == "master" else "slave_time_s"
    at = int(np.searchsorted(run.signals[of_side], time_s + 1e-9)) - 1
    signals = {name.removeprefix("slave_"): value(run, name, at) for name in (MASTER if side == "master" else SLAVE)}
    if side == "master":
        signals["true_position"] = signals["position"]
        signals["peer_state"] = "engaged"
    own_s = time_s + (SLAVE_LATER_S if side == "slave" else 0.0)
    return TelemetrySample(time_ns=round(own_s * 1e9), ticks=16, dropped=0, unsent_changes=0, signals=signals)


def told(run: Run, until_s: float, *sides: str) -> LiveDescription:
    live = LiveDescription(*(hello(run, side) for side in sides))
    for time_s in np.arange(0.0, until_s, 1.0 / 60.0):
        for side in sides:
            live.take(sample(run, side, float(time_s)), side, received_s=100.0 + float(time_s))
    return live


@pytest.mark.parametrize("name", ["remote_push", "three_axis_box"])
def test_what_is_where_now_is_what_the_run_has(name: str) -> None:
    run, _, whole = shown(name)
    live = told(run, 2.75, "master", "slave")
    now = live.at_now()
    then = whole.at(now.time_s)
    assert {part.name for part in live.description.parts} >= {part.name for part in whole.parts}
    for part in ("stylus", "tool", "ghost of the command", "hand", "contact 0"):
        if part in then.poses:
            given, expected = now.poses[part], then.poses[part]
            assert (given is None) == (expected is None), part
            if given is not None and expected is not None and part != "hand":
                assert given == pytest.approx(expected, abs=1e-9), part
    # Along y a trail of one axis moves by its age, which differs by less than a sample.
    assert now.trails["tool trail"][-1][[0, 2]] == pytest.approx(then.trails["tool trail"][-1][[0, 2]], abs=1e-9)
    assert (now.status.master, now.status.slave) == (then.status.master, then.status.slave) == ("engaged", "engaged")
    assert now.status.device_force == pytest.approx(then.status.device_force)
    assert now.status.environment_force == pytest.approx(then.status.environment_force)
    assert [gauge.value for gauge in now.status.gauges] == pytest.approx([gauge.value for gauge in then.status.gauges])


def test_all_that_moves_is_seen_and_no_arrow_is_longer_than_its_view() -> None:
    run, _, _ = shown("three_axis_box")
    live = LiveDescription(hello(run, "master"), hello(run, "slave"))
    generations = set()
    for time_s in np.arange(0.0, 4.0, 1.0 / 60.0):
        for side in ("master", "slave"):
            live.take(sample(run, side, float(time_s)), side, received_s=float(time_s))
        generations.add(live.generation)
        for name, (low, high) in zip(("stylus", "tool"), live.description.views.values(), strict=True):
            at = live.at_now().poses[name]
            assert at is not None
            assert np.all(at[:3, 3] > low)
            assert np.all(at[:3, 3] < high)
        for arrow in live.description.arrows:
            low, high = live.description.views[arrow.station]
            assert arrow.length(live.time_s) < float((high - low).max())
    # Each generation rebuilds everything, so there must be few.
    assert len(generations) < 15


def test_one_side_alone_is_one_end() -> None:
    run, _, _ = shown("remote_push")
    assert set(told(run, 0.5, "master").description.views) == {"hand"}
    slave = told(run, 0.5, "slave")
    assert set(slave.description.views) == {"robot"}
    assert slave.time_s == pytest.approx(SLAVE_LATER_S + 29 / 60)
    tool = slave.at_now().poses["tool"]
    assert tool is not None
    assert tool[0, 3] == pytest.approx(run.signals["slave_position"][483], abs=1e-9)


def test_events_are_on_the_time_line_on_one_clock() -> None:
    run, _, _ = shown("remote_push")
    live = told(run, 0.5, "master", "slave")
    assert live.generation >= 2
    live.take(TelemetryChange(time_ns=400_000_000, signal="tripped", from_=0, to=4), "master")
    live.take(TelemetryChange(time_ns=3_410_000_000, signal="state", from_="aligning", to="engaged"), "slave")
    live.take(TelemetryChange(time_ns=3_410_000_000, signal="reason", from_="", to="both sides aligned"), "slave")
    live.take(TelemetryLost(ticks=7), "slave")
    marks = live.refresh().timeline.marks
    assert [mark.kind for mark in marks] == ["trip", "engaged"]
    assert [mark.time_s for mark in marks] == pytest.approx([0.4, 0.41])
    assert live.at_now().status.reason == "slave: both sides aligned"
    assert live.lost_ticks == 7
    live.take(TelemetryEnd(time_ns=0), "master")
    assert not live.has_ended
    live.take(TelemetryEnd(time_ns=0), "slave")
    assert live.has_ended


def test_two_of_one_side_and_a_message_of_neither_are_refused() -> None:
    run, _, _ = shown("remote_push")
    with pytest.raises(ValueError, match="must be of master, slave, or one of each"):
        LiveDescription(hello(run, "slave"), hello(run, "slave"))
    live = told(run, 0.1, "master", "slave")
    with pytest.raises(ValueError, match="side = None: must be 'master' or 'slave'"):
        live.take(TelemetryLost(ticks=1))
    with pytest.raises(ValueError, match="--arm ur99: must be one of ur3"):
        LiveDescription(hello(run, "slave"), arm="ur99")


def test_a_history_keeps_the_newest() -> None:
    history = History({"time_s": 0, "force": 2, "slave_time_s": 0, "slave_x": 0}, most=4)
    assert np.isnan(history["force"]).all()
    for n in range(23):
        history.append("time_s", {"time_s": float(n), "force": [n, -n]})
    assert history["time_s"].tolist() == [19.0, 20.0, 21.0, 22.0]
    assert history["force"][:, 1].tolist() == [-19.0, -20.0, -21.0, -22.0]
    assert not history.has_begun("slave_time_s")
    assert np.isnan(history["slave_x"]).all()


def test_a_side_that_fell_silent_is_where_it_was() -> None:
    run, _, _ = shown("remote_push")
    live = told(run, 1.0, "master", "slave")
    before = live.at_now().poses["tool"]
    for time_s in np.arange(1.0, 4.0, 1.0 / 60.0):
        live.take(sample(run, "master", float(time_s)), "master", received_s=100.0 + float(time_s))
    now = live.at_now()
    assert now.poses["tool"] == pytest.approx(before)
    assert now.trails["tool trail"].shape == (0, 3)
