"""The panel of a live side: its content from telemetry, and its layout."""

import io
import json
import math
import re
from typing import Any

import pytest
from msgspec import structs
from rich.console import Console

from haptether.bridge import (
    TelemetryCause,
    TelemetryChange,
    TelemetryCleared,
    TelemetryEnd,
    TelemetryHello,
    TelemetryLink,
    TelemetryLost,
    TelemetrySample,
    TelemetrySignal,
    load_scene,
    scene_json,
)
from haptether.bridge.flight import Step
from haptether.view import SideState, headline, panel
from haptether.view.console.summary import summary
from haptether.view.terminal.panel import MARGIN

KINDS = {
    "position": "axes", "velocity": "axes", "rendered_force": "axes", "device_force": "axes", "safety_force": "axes",
    "velocity_force": "number", "grasp": "number", "windowed_energy_j": "number", "energy_j": "number",
    "tripped": "bits", "state": "name", "reason": "name", "peer_state": "name", "clutch": "flag",
    "overshoot_s": "number", "round_trip_s": "number", "age_s": "number", "fault": "count", "trigger": "number",
}  # fmt: skip
SAFETY = {"controllers": ["vfc", "wsc", "pc"], "grasp_threshold": 1.5, "energy_threshold_j": -0.03}


def hello(
    *, side: str = "master", security: str = "secure", scene: dict[str, Any] | None = None, axes: int = 1
) -> TelemetryHello:
    signals = [
        TelemetrySignal(name=name, kind=kind, size=axes if kind == "axes" else 1, meaning="")
        for name, kind in KINDS.items()
    ]
    return TelemetryHello(
        schema=1, side=side, security=security, version="0.1.0", process=4242, scene=scene, signals=signals
    )


def sample(time_s: float, *, axes: int = 1, **changes: Any) -> TelemetrySample:  # noqa: ANN401  # by the kind
    nothing: dict[str, Any] = {
        "axes": [[0.0, 0.0, 0.0]] * axes, "number": [None, None, None], "bits": [0, 0], "flag": False, "count": 0,
        "name": "",
    }  # fmt: skip
    signals = {name: nothing[kind] for name, kind in KINDS.items()} | changes
    return TelemetrySample(time_ns=round(time_s * 1e9), ticks=16, dropped=0, unsent_changes=0, signals=signals)


def shown(state: SideState, width: int = 100) -> str:
    screen = io.StringIO()
    Console(width=width, file=screen, color_system=None).print(panel(state))
    return screen.getvalue()


def test_every_number_has_its_unit() -> None:
    state = SideState(hello())
    state.take(sample(0.0, round_trip_s=[0.001, 0.001, 0.001]))
    text = shown(state)
    for label in ("position [m]", "velocity [m/s]", "F_v [N]", "round trip [ms]"):
        assert label in text


def test_extremes_are_those_of_the_last_second_and_a_spike_of_one_tick_stays() -> None:
    state = SideState(hello())
    state.take(sample(0.0, device_force=[[-9.0, 9.0, 0.0]]))
    assert state.peak("device_force") == 9.0
    for number in range(1, 100):
        spike = [[-0.5, 7.0, 0.25]] if number == 40 else [[-0.5, 0.5, 0.25]]
        state.take(sample(number / 60, device_force=spike))
    assert state.extremes("device_force") == (-0.5, 7.0)
    assert state.last("device_force") == [0.25]
    for number in range(100, 160):
        state.take(sample(number / 60, device_force=[[-0.5, 0.5, 0.25]]))
    assert state.peak("device_force") == 0.5
    assert state.extremes("round_trip_s") is None, "it was null"
    assert state.ticks == 160 * 16
    assert state.watched_s == pytest.approx(159 / 60)


@pytest.mark.parametrize(
    ("controller", "signal", "values", "share", "trips_above"),
    [
        ("vfc", "velocity_force", [0.1, 0.75, 0.2], 0.75, True),
        ("wsc", "windowed_energy_j", [-0.015, 0.5, 0.5], 0.5, False),
        ("wsc", "windowed_energy_j", [-0.06, 0.5, 0.5], 2.0, False),
        ("wsc", "windowed_energy_j", [0.2, 0.5, 0.5], 0.0, False),
        ("pc", "energy_j", [0.01, 0.1, 0.1], 0.0, False),
        ("pc", "energy_j", [-0.01, 0.1, 0.1], 1.0, False),
        ("vfc", "velocity_force", [None, None, None], None, True),
    ],
)
def test_an_observer_is_as_near_to_its_threshold_as_it_came(
    controller: str, signal: str, values: list[float | None], share: float | None, trips_above: bool
) -> None:
    state = SideState(hello(scene={"safety": SAFETY}))
    changes: dict[str, Any] = {signal: values}
    state.take(sample(0.0, **changes))
    observers = {one.controller: one for one in state.observers()}
    assert list(observers) == ["vfc", "wsc", "pc"], "those of the scene"
    assert observers[controller].share == (None if share is None else pytest.approx(share))
    assert observers[controller].trips_above is trips_above
    assert observers[controller].value == values[2]


def test_without_a_scene_those_that_observe_are_shown_without_a_threshold() -> None:
    state = SideState(hello())
    state.take(sample(0.0, grasp=[0.5, 2.0, 1.0]))
    (one,) = state.observers()
    assert (one.controller, one.worst, one.threshold, one.share) == ("hsc", 2.0, None, None)
    assert "S_h = 1" in shown(state)


def test_a_trip_is_shown_for_a_second_and_is_an_event() -> None:
    state = SideState(hello(scene={"safety": SAFETY}))
    state.take(TelemetryChange(time_ns=10**8, signal="tripped", from_=0, to=4))
    state.take(TelemetryChange(time_ns=11**8, signal="tripped", from_=4, to=20))
    state.take(TelemetryChange(time_ns=12**8, signal="tripped", from_=20, to=0))
    assert [text for _, text in state.events] == ["trip wsc", "trip held"]
    state.take(sample(0.1, tripped=[4, 0]))
    assert {one.controller for one in state.observers() if one.tripped} == {"wsc"}
    state.take(sample(0.9, tripped=[16, 16]))
    assert state.is_held()
    assert "TRIPPED" in shown(state)
    state.take(sample(2.0))
    assert not state.is_held()
    assert "TRIPPED" not in shown(state)


def test_a_cause_is_said_in_the_words_of_its_side_until_it_is_over() -> None:
    state = SideState(hello())
    state.take(sample(0.5, state="hold", reason="peer reports a fault", peer_state="fault"))
    steps = [
        Step(at="slave", remedy="acknowledge", text="mend the cause, then acknowledge it at the slave"),
        Step(at="master", remedy="press", text="release the clutch at the master and press it again"),
    ]
    cause = TelemetryCause(
        time_ns=5 * 10**8, state="hold", at="slave", text="ur: protective stop: C153A1: [red]joint 2", steps=steps
    )
    state.take(cause)
    text = shown(state, 120)
    assert "slave: ur: protective stop: C153A1: [red]joint 2" in text, "no markup of the terminal"
    assert "kill -USR2 PID" in text
    assert "kill -USR1 4242" in text
    assert headline(state) == "HOLD  peer reports a fault  clutch open  slave: fault"
    state.take(TelemetryCleared(time_ns=6 * 10**8))
    assert "kill" not in shown(state)


def test_what_was_not_seen_is_counted_and_the_end_is_known() -> None:
    state = SideState(hello(security="insecure"))
    state.take(sample(0.0))
    state.take(TelemetryLost(ticks=32))
    assert "ticks not seen here" in shown(state)
    assert "INSECURE: frames are in plain sight" in shown(state)
    assert not state.has_ended
    state.take(TelemetryEnd(time_ns=10**9))
    assert state.has_ended


@pytest.mark.parametrize("axes", [1, 3, 6, 7])
@pytest.mark.parametrize("side", ["master", "slave"])
def test_it_fits_80_columns_whatever_is_in_it(axes: int, side: str) -> None:
    state = SideState(hello(scene={"safety": SAFETY, "master": {"kind": "joints"}}, axes=axes, side=side))
    assert "NO SAMPLE YET" in shown(state)
    large = [[-1e4, 1e4, -1e4 / 3]] * axes
    numbers: dict[str, Any] = {name: [1e-9, 1e9, math.pi * 1e6] for name, kind in KINDS.items() if kind == "number"}
    vectors: dict[str, Any] = dict.fromkeys([name for name, kind in KINDS.items() if kind == "axes"], large)
    state.take(sample(1e5, axes=axes, state="engaged", reason="x" * 60, clutch=True, **numbers, **vectors))
    state.take(TelemetryCause(time_ns=10**14, state="hold", at="master", text="y" * 300, steps=[]))
    lines = shown(state, 80).splitlines()
    assert max(map(len, lines)) <= 80
    assert all(line[0] in "╭│╰" for line in lines)
    assert any("requested F_v [N m]" in line for line in lines), "torques of joints"


def test_missing_numbers_are_dashes() -> None:
    state = SideState(hello(axes=3))
    state.take(sample(0.0, axes=3, position=[[None, None, None], [0.1, 0.1, 0.1], [0.0, 0.0, 0.0]]))
    assert "-  +0.1000  +0.0000" in shown(state)


@pytest.mark.parametrize(
    ("before", "now", "loss"),
    [
        ((100, 0, 0), (160, 0, 0), 0.0),
        ((100, 0, 0), (150, 4, 6), 0.1),
        # Missing packets have arrived late.
        ((100, 0, 9), (140, 9, 0), 0.0),
        ((100, 0, 9), (100, 0, 9), None),
    ],
)
def test_loss_is_the_share_of_the_last_second(
    before: tuple[int, int, int], now: tuple[int, int, int], loss: float | None
) -> None:
    state = SideState(hello())
    assert state.loss() is None
    for time_s, (fresh, late, missing) in ((0.0, (0, 0, 0)), (1.5, before), (2.0, now)):
        link = TelemetryLink(sent=0, fresh=fresh, late=late, missing=missing)
        state.take(structs.replace(sample(time_s), link=link))
    assert state.loss() == (None if loss is None else pytest.approx(loss))
    assert ("frames lost [%]" in shown(state)) == (loss is not None)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (
            ["coupling.kind=pd-damped", "coupling.stiffness=100", "coupling.damping=3"],
            3.0 / (100.0 * (0.041 / 2 + 1e-3)),
        ),
        (
            ["coupling.kind=pd-damped", "coupling.stiffness=100", "coupling.damping=2"],
            2.0 / (100.0 * (0.041 / 2 + 1e-3)),
        ),
        (["coupling.kind=position-position"], None),
        ([], None),
    ],
)
def test_the_margin_is_that_of_the_longest_round_trip_of_the_last_second(
    overrides: list[str], expected: float | None
) -> None:
    """B over `K ((T1 + T2) / 2 + dT)`, with one period more of the round trip."""
    scene = json.loads(scene_json(load_scene("remote_push", overrides)))
    state = SideState(hello(scene=scene))
    assert state.passivity_margin() is None, "no round trip yet"
    state.take(sample(0.0, round_trip_s=[0.01, 0.04, 0.02]))
    margin = state.passivity_margin()
    values = {value["label"]: value["values"] for value in summary(state, "", "")["values"]}
    if expected is None:
        assert margin is None
        assert MARGIN not in shown(state)
        assert MARGIN not in values
        return
    assert margin == pytest.approx(expected)
    assert values[MARGIN] == [margin]
    assert f"{expected:.2f}" in next(line for line in shown(state).splitlines() if MARGIN in line)


@pytest.mark.parametrize(("stiffness", "expected"), [(None, 1.0), (0.5, 0.5), (0.1, 1.0)])
def test_the_margin_of_a_pose_is_the_smaller_of_translation_and_rotation(
    stiffness: float | None, expected: float
) -> None:
    gains = ["coupling.kind=pd-damped", "coupling.stiffness=100", "coupling.damping=3"]
    # At a lever of 50 mm, 100 N/m are 0.25 N m/rad.
    gains += [] if stiffness is None else [f"coupling.rotational_stiffness={stiffness}"]
    state = SideState(hello(scene=json.loads(scene_json(load_scene("valve", gains))), axes=3))
    state.take(sample(0.0, axes=3, round_trip_s=[0.04, 0.04, 0.04]))
    assert state.passivity_margin() == pytest.approx(expected * 3.0 / (100.0 * (0.041 / 2 + 1e-3)))


def test_after_a_switch_the_margin_is_that_of_the_other_coupling() -> None:
    gains = ["coupling.kind=pd-damped", "coupling.stiffness=100", "coupling.damping=3"]
    other = ["coupling.alternatives=[{kind='pd-damped', stiffness=50, damping=4}]", "coupling.kind=wave"]
    state = SideState(hello(scene=json.loads(scene_json(load_scene("remote_push", [*gains, *other])))))
    margins = []
    for time_s, kind in enumerate(("wave", "pd-damped", "position-position")):
        message = sample(float(time_s), round_trip_s=[0.04, 0.04, 0.04])
        state.take(structs.replace(message, link=TelemetryLink(coupling=kind)))
        margins.append(state.passivity_margin())
    # No delay lies in the loop of a wave, so its least B is K dT.
    assert margins == [pytest.approx(3.0 / (100.0 * 1e-3)), pytest.approx(4.0 / (50.0 * (0.041 / 2 + 1e-3))), None]
    assert [text for _, text in state.events] == ["coupling pd-damped", "coupling position-position"]
    assert "coupling pd-damped" in shown(state)


@pytest.mark.parametrize(
    "coupling",
    [
        "pd-damped",
        {"kind": "wave", "alternatives": [3]},
        {"kind": "wave", "alternatives": None},
        None,
        {},
        [],
        {"kind": 3},
        {"kind": "pd-damped", "stiffness": "K", "damping": {}},
    ],
)
def test_a_margin_of_odd_settings_is_not_shown(coupling: object) -> None:
    state = SideState(hello(scene={"coupling": coupling, "run": {"period_s": 1e-3}, "slave": {"period_s": 1e-3}}))
    link = TelemetryLink(coupling="tdpa")
    state.take(structs.replace(sample(0.0, round_trip_s=[0.04, 0.04, 0.04]), link=link))
    assert state.passivity_margin() is None


@pytest.mark.parametrize("height", [None, 60, 14])
def test_a_panel_of_few_lines_has_no_room_and_no_events(height: int | None) -> None:
    state = SideState(hello(scene={"safety": SAFETY}))
    state.take(TelemetryChange(time_ns=10**8, signal="state", from_="aligning", to="engaged"))
    for time_s in (0.1, 0.2):
        state.take(sample(time_s, round_trip_s=[0.001, 0.001, 0.001], state="engaged"))
    screen = io.StringIO()
    Console(width=60, file=screen, color_system=None).print(panel(state, 60, height))
    text = screen.getvalue()
    assert "round trip [ms]" in text
    assert max(map(len, text.splitlines())) <= 60
    is_short = height == 14
    assert (re.search(r"│ {50,}│", text) is None) == is_short
    assert ("0.100  engaged" in text) != is_short
