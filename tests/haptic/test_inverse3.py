"""The driver of an Inverse3 against the emulated service: frames, forces, faults and recovery."""

import itertools
import json
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from tests.haptic.emulated import EmulatedInverse, emulated_service
from tests.haptic.ticks import begun, step, until
from tests.ur.stalls import anew_after_stalls

from haptether.checklist import Checklist, RefusedError
from haptether.master.inverse3 import Inverse3
from haptether.master.inverse3.channel import Channel
from haptether.master.inverse3.checks import check_events, opened_events
from haptether.master.inverse3.driver import MAX_LATE
from haptether.master.inverse3.emulator import EmulatedInverse3, EmulatedSettings, Service
from haptether.master.inverse3.emulator.service import DEVICE_ID
from haptether.master.inverse3.messages import ForceMessage, InverseDevice, MessageError, configuration, reply
from haptether.master.inverse3.options import inverse3_options

pytestmark = pytest.mark.live

HOME = (0.0, -0.12, 0.15)


def opened(service: EmulatedInverse, **options: Any) -> closing[Inverse3]:  # noqa: ANN401  # options of the driver
    return begun(Inverse3(**{**service.options, **options}))


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedInverse]:
    with emulated_service() as service:
        yield service


@pytest.fixture
def service(shared: EmulatedInverse) -> EmulatedInverse:
    """Return the same process for each test, in its initial state."""
    for line in ("ebrake off", "grip wake", "grip back", "plug", "drop 0", "twice 0", "delay 0", "stall 0",
                 "push 0 0 0",
                 "hand 0 -0.12 0.15", "turn 1 0 0 0", "buttons", "disconnect"):  # fmt: skip
        shared.do(line)
    for name in ("power_supply", "started", "calibrated", "ready"):
        shared.do(f"set {name} on")
    shared.do("set in_use off")
    return shared


# ------------------------------------------------------------------------------------------------ frames, signs, units


@pytest.mark.parametrize(
    ("axes", "ours"),
    [(["x", "y", "z"], (0.02, 0.01, -0.03)), (["-y", "x", "z"], (-0.01, 0.02, -0.03)), (["z"], (-0.03,))],
)
def test_positions_and_forces_are_turned_into_our_frame(
    service: EmulatedInverse, axes: list[str], ours: tuple[float, ...]
) -> None:
    service.do("hand 0.02 -0.11 0.12")
    with opened(service, axes=axes) as driver:
        # Friction of 0.038 N at 200 N/m leaves 0.2 mm.
        sample = until(driver, lambda sample: np.allclose(sample.position, ours, atol=4e-4), (0.0,) * len(axes))
        assert sample.fault is None
        assert (sample.orientation, sample.buttons, sample.velocity) == (None, None, None)
        # 2 N on the hand's spring of 200 N/m are 10 mm along the first of our axes.
        pushed = (ours[0] + 0.01, *ours[1:])
        force = (2.0, 0.0, 0.0)[: len(axes)]
        until(driver, lambda sample: np.allclose(sample.position, pushed, atol=4e-4), force)
        index = "xyz".index(axes[0].removeprefix("-"))
        commanded = [0.0, 0.0, 0.0]
        commanded[index] = -2.0 if axes[0].startswith("-") else 2.0
        step(driver, force)
        assert service.status()["commanded"] in (commanded, [0.0, 0.0, 0.0])


def test_a_pose_has_the_grips_orientation_and_buttons(service: EmulatedInverse) -> None:
    half = 0.5**0.5
    # The turn is about the device's x; with -y, x, z as our axes that is our y.
    service.do(f"turn {half} {half} 0 0")
    service.do("buttons a c")
    with opened(service, grip="wireless", axes=["-y", "x", "z"]) as driver:
        assert driver.kinds == ("linear", "pose")
        sample = step(driver)
        assert sample.orientation == pytest.approx((half, 0.0, half, 0.0))
        assert sample.buttons == 0b101
        # Torque is not exerted, and not an error.
        driver.read()
        driver.write((0.0, 0.0, 1.0), (0.0, 0.0, 0.3))


def test_long_forces_are_shortened_and_bad_ones_are_none(service: EmulatedInverse) -> None:
    with opened(service, max_force_n=1.0) as driver:
        for force, sent in (((3.0, 0.0, 4.0), [0.6, 0.0, 0.8]), ((float("nan"), 0.0, 0.0), [0.0, 0.0, 0.0])):
            seen = [[0.0, 0.0, 0.0]]
            # A service that waits for 20 ms idles.
            for _ in range(20):
                step(driver, force, 20)
                seen.append(service.status()["commanded"])
            assert sent in seen
            assert all(one in (sent, [0.0, 0.0, 0.0]) for one in seen)


def test_velocity_of_the_service_is_taken_where_it_is_asked_for(service: EmulatedInverse) -> None:
    with opened(service, device_velocity=True) as driver:
        assert step(driver).velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.01)


def test_forces_end_without_messages(service: EmulatedInverse) -> None:
    with opened(service) as driver:
        step(driver, (1.0, 0.0, 0.0), 10)
        time.sleep(0.1)
        assert service.wait_for("idle", value=True)["force"] == [0.0, 0.0, 0.0]
        assert driver.read().fault is None


def test_a_force_is_sent_only_for_a_tick_that_was_read(service: EmulatedInverse) -> None:
    with opened(service) as driver:
        driver.read()
        driver.write((1.0, 0.0, 0.0))
        driver.write((1.0, 0.0, 0.0))
        # The service has answered both by then.
        driver.read()
        assert service.status()["commanded"] == [0.0, 0.0, 0.0]


# --------------------------------------------------------------------------------------------------------- checklist


@pytest.mark.parametrize(
    ("lines", "options", "said"),
    [
        (["set calibrated off"], {}, "status: not calibrated: put the arm into its calibration pose"),
        (["set power_supply off"], {}, "status: no power"),
        (["set in_use on"], {}, "status: in use: another program moves it"),
        (["unplug"], {}, "Inverse3: none: is it plugged in"),
        ([], {"device_id": "049D"}, "must have 049D"),
        (["grip sleep"], {"grip": "wireless"}, "VerseGrip: grip asleep: press one of its buttons"),
        (["grip gone"], {"grip": "wireless"}, "VerseGrip: none: there must be one in wireless_verse_grip"),
        ([], {"grip": "wired"}, "VerseGrip: none: there must be one in verse_grip"),
        ([], {"event_port": 1}, "events: 127.0.0.1:1: Connection refused"),
        ([], {"port": 1}, "service: 127.0.0.1:1: Connection refused: is the Inverse Service running"),
    ],
)
def test_a_device_that_is_not_ready_is_refused(
    service: EmulatedInverse, lines: list[str], options: dict[str, object], said: str
) -> None:
    for line in lines:
        service.do(line)
    driver = Inverse3(**{**service.options, **options})
    with pytest.raises(RefusedError) as refused:
        driver.open()
    driver.close()
    assert said in str(refused.value)
    service.wait_for("clients", 0)


def test_the_ordinary_port_is_no_port_of_events(service: EmulatedInverse) -> None:
    with pytest.raises(ValueError, match=r"event_port = .*: must be another port than `port`"):
        Inverse3(**{**service.options, "event_port": service.port})
    options = inverse3_options({"port": 1, "event_port": service.port})
    checklist = Checklist("inverse3", lambda _: None)
    events = opened_events(options, checklist)
    try:
        assert events.peek(5.0) is not None
        with pytest.raises(RefusedError, match=r"malformed event: .*: event_port must be that of the events"):
            check_events(events, options, checklist)
    finally:
        events.close()


def test_a_frame_that_was_peeked_at_stays(service: EmulatedInverse) -> None:
    channel = Channel("127.0.0.1", service.port)
    try:
        first = channel.peek(5.0)
        assert first is not None
        assert channel.peek(0.0) == first
        assert channel.frame(0.0) == first
    finally:
        channel.close()


def test_the_checklist_says_what_changes_forces(service: EmulatedInverse, capfd: pytest.CaptureFixture[str]) -> None:
    with opened(service, force_gate=0.0):
        pass
    told = capfd.readouterr().err
    for line in ("force gate: 0", "damping: ", "gravity compensation: 1", "torque scaling: on", "handedness: right"):
        assert line in told
    with opened(service):
        pass
    # The service still has the earlier setting.
    assert "force gate: 0.0: the service alters" in capfd.readouterr().err


# ------------------------------------------------------------------------------------------------------------ faults


STATE_FAULTS = [
    (["ebrake on"], ["ebrake off"], "e-brake: the emergency brake is on"),
    (["trip stall"], [], "stall: a motor pushes"),
    (["trip ceiling"], [], "unstable: "),
    (["trip overload"], [], "overload: "),
    (["set calibrated off"], ["set calibrated on"], "not calibrated: "),
    (["set in_use on"], ["set in_use off"], "in use: "),
    (["set power_supply off"], ["set power_supply on"], "no power: "),
    (["grip sleep"], ["grip wake"], "grip asleep: "),
    (["push 0 5 0"], ["push 0 0 0"], "force of another: the service exerts "),
]
LINK_FAULTS = [
    (["drop 1"], [], "lost reply: none within 0.05 s"),
    (["delay 60"], ["delay 0"], "lost reply: "),
    (["stall 200"], ["stall 0"], "lost reply: "),
    (["disconnect"], [], "closed by the service"),
    (["garble text"], [], "malformed reply: "),
    (["garble nan"], [], "malformed reply: "),
    (["garble infinite"], [], "malformed reply: "),
    (["garble statusless"], [], "malformed reply: Object missing required field `status`"),
    (["grip gone"], ["grip back"], "grip lost: "),
    (["turn 0.1 0 0 0"], ["turn 1 0 0 0"], "malformed reply: orientation (0.1, 0.0, 0.0, 0.0) has norm 0.1"),
]


@pytest.mark.parametrize(("wrong", "mended", "said"), STATE_FAULTS + LINK_FAULTS)
@anew_after_stalls
def test_a_fault_is_named_ends_the_force_and_stays_until_it_is_acknowledged(
    service: EmulatedInverse, wrong: list[str], mended: list[str], said: str
) -> None:
    with opened(service, grip="wireless") as driver:
        assert step(driver, (0.5, 0.0, 0.0), 20).fault is None
        for line in wrong:
            service.do(line)
        sample = until(driver, lambda sample: sample.fault is not None, (0.5, 0.0, 0.0))
        assert sample.fault is not None
        assert said in sample.fault
        # There is no force for any command, and the fault stays though its cause is gone.
        for line in mended:
            service.do(line)
        step(driver, (0.5, 0.0, 0.0), 30)
        assert service.status()["commanded"] == [0.0, 0.0, 0.0]
        assert driver.read().fault is not None
        # One acknowledgement suffices, or two after a lost connection: its new state must be seen first. Each reply
        # that is late because of this machine takes one more.
        acts = 0
        while (fault := step(driver, (0.5, 0.0, 0.0), 20).fault) is not None:
            acts += 1
            assert acts <= 10, fault
            driver.acknowledge()
            time.sleep(0.01)


def test_a_reply_of_before_is_never_taken_for_a_new_one(service: EmulatedInverse) -> None:
    """A late reply belongs to a connection that is closed by then."""
    with opened(service) as driver:
        step(driver, ticks=5)
        service.do("delay 100")
        until(driver, lambda sample: sample.fault is not None)
        service.do("hand 0.03 -0.12 0.15")
        service.do("delay 0")
        time.sleep(0.2)
        sample = until(driver, lambda _: True)
        while sample.fault is not None:
            driver.acknowledge()
            time.sleep(0.01)
            sample = step(driver)
        assert sample.position == pytest.approx((0.03, 0.0, 0.0), abs=5e-4)


@pytest.mark.parametrize(
    "wrong", ["drop 1", "delay 60", "garble text", "garble nan", "garble infinite", "garble statusless", "grip gone"]
)
@anew_after_stalls
def test_the_last_that_a_lost_connection_is_sent_is_a_zero_force(service: EmulatedInverse, wrong: str) -> None:
    with opened(service, grip="wireless") as driver:
        step(driver, (0.5, 0.0, 0.0), 20)
        assert any(service.status()["sent"])
        service.do(wrong)
        until(driver, lambda sample: "acknowledge to connect anew" in str(sample.fault), (0.5, 0.0, 0.0))
        service.do("delay 0")
        service.wait_for("clients", 0)
        assert service.status()["sent"] == [0.0, 0.0, 0.0]


def test_a_device_that_a_lost_connection_left_is_sent_zero_before_it_is_refused(service: EmulatedInverse) -> None:
    with opened(service) as driver:
        step(driver, (0.5, 0.0, 0.0), 20)
        # The service is gone before a zero can be sent, and comes back in a state that is refused.
        service.do("disconnect")
        until(driver, lambda sample: "acknowledge to connect anew" in str(sample.fault), (0.5, 0.0, 0.0))
        assert any(service.status()["sent"])
        service.do("set calibrated off")
        driver.acknowledge()
        until(driver, lambda sample: "not calibrated" in str(sample.fault))
        assert service.status()["sent"] == [0.0, 0.0, 0.0]


def test_a_frame_that_nobody_asked_for_is_a_fault(service: EmulatedInverse) -> None:
    with opened(service) as driver:
        step(driver, ticks=5)
        service.do("twice 1")
        sample = until(driver, lambda sample: sample.fault is not None)
        assert sample.fault is not None
        assert "unasked frame" in sample.fault
        driver.acknowledge()
        assert step(driver, ticks=5).fault is None


def test_a_brake_that_is_still_on_is_a_fault_again(service: EmulatedInverse) -> None:
    with opened(service) as driver:
        service.do("ebrake on")
        until(driver, lambda sample: sample.fault is not None)
        driver.acknowledge()
        sample = step(driver)
        assert sample.fault is not None
        assert "still on" in sample.fault


def test_a_brake_outlasts_the_connection(service: EmulatedInverse) -> None:
    with opened(service) as driver:
        service.do("ebrake on")
        until(driver, lambda sample: sample.fault is not None)
        service.do("disconnect")
        until(driver, lambda sample: "acknowledge to connect anew" in str(sample.fault))
        driver.acknowledge()
        until(driver, lambda sample: "connected anew" in str(sample.fault))
        driver.acknowledge()
        sample = step(driver, (2.0, 0.0, 0.0), ticks=5)
        assert "the emergency brake is still on" in str(sample.fault)
        assert service.status()["commanded"] == [0.0, 0.0, 0.0]
        service.do("ebrake off")
        time.sleep(0.05)
        step(driver)
        driver.acknowledge()
        assert step(driver, ticks=5).fault is None


@pytest.mark.alone
@pytest.mark.parametrize("stall_ms", [12, 25, 40])
@anew_after_stalls
def test_a_late_reply_costs_the_force_of_its_tick_and_nothing_else(service: EmulatedInverse, stall_ms: int) -> None:
    with opened(service, reply_timeout_s=0.010) as driver:
        step(driver, (0.5, 0.0, 0.0), 20)
        before = driver.late_replies
        service.do(f"stall {stall_ms}")
        driver.read()
        begun_s = time.monotonic()
        driver.write((0.5, 0.0, 0.0))
        sample = driver.read()
        took_s = time.monotonic() - begun_s
        assert sample.fault is None
        assert 1e-3 * stall_ms - 0.002 < took_s < 0.1
        # The zero of the late tick came last, and was answered.
        assert driver.late_replies == before + 1
        assert service.status()["sent"] == [0.0, 0.0, 0.0]
        assert step(driver, (0.5, 0.0, 0.0), 20).fault is None
        assert any(service.status()["sent"])


def sent_n(service: EmulatedInverse) -> float:
    """Return the norm of the last force sent to the service, in N."""
    return float(np.linalg.norm(service.status()["sent"]))


@pytest.mark.parametrize("wanted", [(4.0, 0.0, 0.0), (0.0, -2.4, 1.8)])
@anew_after_stalls
def test_after_a_zero_of_the_drivers_own_the_force_grows_from_zero(
    service: EmulatedInverse, wanted: tuple[float, ...]
) -> None:
    def late(driver: Inverse3) -> None:
        before = driver.late_replies
        service.do("stall 20")
        step(driver, wanted)
        assert driver.read().fault is None
        assert driver.late_replies > before

    def unwritten(driver: Inverse3) -> None:
        driver.read()
        driver.read()

    def unread(driver: Inverse3) -> None:
        driver.write(wanted)
        driver.write(wanted)
        driver.read()

    full = float(np.linalg.norm(wanted))
    with opened(service, reply_timeout_s=0.010) as driver:
        for interrupt in (late, unwritten, unread):
            step(driver, wanted, 20)
            interrupt(driver)
            # A first force may already follow the zero.
            norms = [0.0, sent_n(service)]
            while norms[-1] < full - 1e-6:
                driver.write(wanted)
                assert driver.read().fault is None
                norms.append(sent_n(service))
            assert max(np.diff(norms)) <= 1.0 + 1e-6, norms


@anew_after_stalls
def test_replies_that_are_late_too_often_end_the_force(
    service: EmulatedInverse, capfd: pytest.CaptureFixture[str]
) -> None:
    with opened(service, reply_timeout_s=0.010) as driver:
        step(driver, ticks=5)
        faults = []
        for _ in range(MAX_LATE + 1):
            service.do("stall 20")
            faults.append(step(driver, ticks=2).fault)
        assert faults[:MAX_LATE] == [None] * MAX_LATE
        assert "late replies: 11 within 1 s took longer than reply_timeout_s = 0.01" in str(faults[-1])
        driver.acknowledge()
        until(driver, lambda sample: "connected anew" in str(sample.fault))
        driver.acknowledge()
        assert step(driver, ticks=5).fault is None
    assert "inverse3 127.0.0.1: 11 replies were late" in capfd.readouterr().err


def test_a_reply_that_does_not_come_is_not_waited_for_longer(service: EmulatedInverse) -> None:
    taken = []
    for _ in range(5):
        with opened(service) as driver:
            step(driver, ticks=3)
            service.do("drop 1")
            driver.read()
            driver.write((0.0, 0.0, 0.0))
            begun_s = time.monotonic()
            assert driver.read().fault is not None
            taken.append(time.monotonic() - begun_s)
    # The limit is 50 ms; delays by the machine are not the driver's.
    assert min(taken) < 0.1
    with pytest.raises(ValueError, match="reply_timeout_s"):
        Inverse3(reply_timeout_s=0.016)


def test_it_closes_whatever_it_was_in(service: EmulatedInverse) -> None:
    driver = Inverse3(**service.options)
    driver.close()
    driver = Inverse3(**service.options)
    driver.open()
    step(driver, (1.0, 0.0, 0.0), 5)
    driver.close()
    driver.close()
    assert service.wait_for("clients", 0)["commanded"] == [0.0, 0.0, 0.0]
    driver.write((1.0, 0.0, 0.0))
    assert driver.read().fault is not None


# ------------------------------------------------------------------------------------------------- messages, options


def test_messages_are_as_the_public_client_has_them() -> None:
    message = ForceMessage("049D", ("wireless_verse_grip", "1102"))((0.5, -1e-7, 2.0))
    assert message == (
        b'{"inverse3":[{"device_id":"049D","commands":{"set_cursor_force":{"vector":{"x":0.5,"y":-1e-07,"z":2}}}}]'
        b',"wireless_verse_grip":[{"device_id":"1102","commands":{"probe_orientation":{}}}]}'
    )
    with pytest.raises(ValueError, match="must be finite"):
        ForceMessage("049D", None)((float("inf"), 0.0, 0.0))
    assert configuration("049D", force_gate=0.0, damping=None) == (
        b'{"session":{"configure":{"profile":{"name":"haptether"},"basis":{"permutation":"XYZ"}}},'
        b'"inverse3":[{"device_id":"049D","commands":{"probe_position":{}},"configure":{"force_gate":{"gain":0.0}}}]}'
    )


IDENTITY = {
    "position": {"x": 0.0, "y": 0.0, "z": 0.0},
    "rotation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0},
    "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
}
MOVED = {
    "position": {"x": 0.1, "y": 0.0, "z": 0.0},
    "rotation": {"w": 0.0, "x": 1.0, "y": 0.0, "z": 0.0},
    "scale": {"x": 2.0, "y": 1.0, "z": 1.0},
}
PARTS = [parts for count in range(4) for parts in itertools.combinations(IDENTITY, count)]


def frame_with(transform: object) -> InverseDevice:
    """Return an Inverse3 from a frame of the emulated service with another transform."""
    frame = json.loads(Service(EmulatedInverse3(EmulatedSettings())).first())
    frame["inverse3"][0]["state"]["transform"] = transform
    (device,) = reply(json.dumps(frame).encode()).inverse3
    return device


@pytest.mark.parametrize("parts", PARTS, ids=lambda parts: "+".join(parts) or "none")
def test_parts_of_a_transform_that_are_left_out_change_nothing(parts: tuple[str, ...]) -> None:
    transform = frame_with({part: IDENTITY[part] for part in parts}).state.transform
    assert transform is not None
    assert transform.is_identity
    for part in parts:
        changed = frame_with({name: (MOVED if name == part else IDENTITY)[name] for name in parts}).state.transform
        assert changed is not None
        assert not changed.is_identity, part


def test_a_frame_without_a_transform_is_taken() -> None:
    assert frame_with(None).state.transform is None


@pytest.mark.parametrize("key", ["position", "rotation"])
def test_a_part_without_one_of_its_numbers_is_refused(key: str) -> None:
    part = dict(list(IDENTITY[key].items())[:-1])
    with pytest.raises(MessageError, match="missing required field `z`"):
        frame_with({key: part})


REQUIRED: dict[str, dict[str, Any]] = {
    "state": {"mode": {"idle", "position", "angular"}},
    "status": dict.fromkeys(("calibrated", "in_use", "power_supply", "ready", "started"), frozenset({True, False})),
    "config": {
        **dict.fromkeys(("type", "port", "extended_device_id", "extended_firmware_version"), None),
        **dict.fromkeys(("device_info", "gravity_compensation", "torque_scaling"), None),
        "handedness": {"left", "right"},
    },
    "device_info": dict.fromkeys(("id", "major_version", "minor_version", "device_type", "uuid"), None),
}
"""Fields and known values without which the vendor's public client (crate `haply` 1.3.1) refuses a frame."""


@pytest.mark.parametrize("commanded", [False, True], ids=["idle", "force"])
def test_frames_have_all_that_the_vendors_client_requires(commanded: bool) -> None:
    service = Service(EmulatedInverse3(EmulatedSettings()))
    message = ForceMessage(DEVICE_ID, None)((0.5, 0.0, 0.0)) if commanded else b"{}"
    state_frames = service.receive(message, 0.0)
    full_frames = [service.first(), *service.receive(b'{"session":{"force_render_full_state":{}}}', 0.0)]
    for text in (*state_frames, *full_frames):
        (device,) = json.loads(text)["inverse3"]
        assert ("config" in device) == (text in full_frames)
        places = {**device, "device_info": device.get("config", {}).get("device_info", {})}
        for place in REQUIRED if text in full_frames else ("state", "status"):
            for field, known in REQUIRED[place].items():
                assert field in places[place], (place, field)
                assert known is None or places[place][field] in known, (place, field)
    assert json.loads(state_frames[0])["inverse3"][0]["state"]["mode"] == ("position" if commanded else "idle")


@pytest.mark.parametrize("received", [b"", b"[]", b"{", b'{"inverse3":[{}]}', b"\xff", b"[" * 100_000, b"1e999"])
def test_what_is_no_reply_is_refused(received: bytes) -> None:
    with pytest.raises(MessageError):
        reply(received)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"axes": ["x", "z", "y"]}, "left-handed"),
        ({"axes": ["x", "x", "z"]}, "each once"),
        ({"axes": []}, "one to three"),
        ({"host": "ws://here"}, "host = 'ws://here': must be an IPv4 address or a name"),
        ({"host": "0.0.0.0"}, "host = '0.0.0.0': is the address of no peer"),
        ({"device_id": 'a"b'}, "must be letters and digits"),
        ({"reply_timeout_s": 0.05}, "reply_timeout_s = 0.05: must be 0.002 to 0.015 s"),
        ({"max_force_n": 0.0}, "must be above 0 and at most 20 N"),
        ({"grip": "both"}, "must be one of none, wireless, wired, custom"),
        ({"origin": [2.0, 0.0, 0.0]}, "must be within 1 m"),
        ({"port": "nan"}, "must be finite"),
        ({"speed": 1}, "is no option: must be one of host, port"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match="driver = inverse3") as refused:
        Inverse3(**options)
    assert said in str(refused.value)
