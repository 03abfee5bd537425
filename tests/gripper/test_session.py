"""State machine of the driver with an emulated gripper, in virtual time: its requests, and its use of the replies."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.gripper.virtual import CYCLE_S, MM, Led, gripper, move

from haptether.slave.robotiq.protocol import CONTACT, CONTACT_OPENING, MOVING, Request, get
from haptether.slave.robotiq.session import ECHOED_NS, START, Session
from haptether.slave.ur_emulator import GrippedObject

CONTACT_40_MM = 1.0 - 40.0 / 85.0
COUNT = 1.0 / 227.0


def test_it_moves_nothing_by_itself() -> None:
    led = Led(gripper())
    led.run(2.0)
    assert led.settings == []
    assert led.sample.position == 0.0
    assert led.sample.fault is None


def test_a_command_is_one_setting_and_its_motion_is_seen() -> None:
    led = Led(gripper())
    led.write(move(0.5, speed=1.0, force_n=50.0))
    led.run(0.2)
    # 0.085 m/s of 0.020 to 0.150, 50 N of 20 to 235.
    assert led.settings == ["SET POS 116 SPE 128 FOR 36 GTO 1"]
    assert led.sample.velocity == pytest.approx(1.0, abs=0.1)
    took_s = led.run(2.0, until=lambda sample: sample.position > 0.5 - COUNT)
    # 0.5 at 1 /s, less the 0.2 s that have passed; a reading every 20 ms.
    assert took_s == pytest.approx(0.3, abs=0.03)
    led.run(0.3)
    assert led.sample.velocity == 0.0
    assert not led.sample.holds_object
    assert led.sample.force_n == 0.0


@pytest.mark.parametrize(("position", "end"), [(0.0, 0.0), (1.0, 1.0)])
def test_the_ends_are_reached(position: float, end: float) -> None:
    led = Led(gripper())
    led.write(move(0.3))
    led.run(1.0)
    led.write(move(position))
    led.run(2.0)
    assert led.sample.position == end
    assert led.sample.fault is None


def test_an_object_stops_the_jaws_and_is_held_with_the_force() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0, force_n=100.0))
    led.run(3.0, until=lambda sample: sample.holds_object)
    assert led.sample.position == pytest.approx(CONTACT_40_MM, abs=COUNT)
    assert led.sample.force_n == pytest.approx(100.0, abs=1.0)
    # The object is lost: the jaws close to the end, and hold nothing.
    led.gripper.put(None)
    led.run(2.0)
    assert led.sample.position == 1.0
    assert not led.sample.holds_object
    assert led.sample.force_n == 0.0


def test_another_force_is_set_without_the_position() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0, force_n=50.0))
    led.run(2.0)
    led.write(move(1.0, force_n=150.0))
    # The driver does not report it as lost even for a moment.
    assert led.run(1.0, until=lambda sample: not sample.holds_object) >= 1.0
    assert led.settings[1:] == ["SET FOR 154"]
    assert led.sample.force_n == pytest.approx(150.0, abs=1.0)


def test_a_leap_between_two_readings_is_a_sample_all_the_same() -> None:
    led = Led(gripper(), answer=lambda request, value: 255 if request.reads == "POS" else value)
    led.run(0.004)
    assert led.sample.velocity == 100.0


def test_contact_seen_long_after_the_last_position_is_kept() -> None:
    led = Led(gripper(40.0), round_trip_s=0.004)
    led.write(move(1.0, speed=1.5, force_n=100.0))
    led.run(1.0, until=lambda sample: 0.1 < sample.position < 0.3)
    # The computer pauses until the jaws have met the object; then the driver reads OBJ before the position.
    led.now_s += 2.0
    led.gripper.advance(led.now_s)
    sent_ns = led.now_ns
    led.session.replied(get("OBJ"), led.gripper.read("OBJ"), sent_ns, led.now_ns)
    assert led.sample.holds_object
    assert led.run(1.0, until=lambda sample: not sample.holds_object) >= 1.0
    assert led.sample.position == pytest.approx(CONTACT_40_MM, abs=COUNT)
    led.gripper.put(None)
    led.run(0.5)
    assert not led.sample.holds_object


def test_an_object_is_held_from_inside() -> None:
    led = Led(gripper())
    led.write(move(1.0))
    led.run(2.0)
    led.gripper.put(GrippedObject(width_m=30.0 * MM, inside=True))
    led.write(move(0.0))
    led.run(2.0)
    assert led.sample.holds_object
    assert led.sample.position == pytest.approx(1.0 - 30.0 / 85.0, abs=COUNT)


def test_contact_of_the_request_before_is_not_taken_for_the_newest() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0))
    led.run(2.0)
    assert led.sample.holds_object
    led.write(move(0.0))
    released_s = led.run(1.0, until=lambda sample: not sample.holds_object)
    assert released_s < 0.1
    led.run(0.05)
    assert not led.sample.holds_object


# ------------------------------------------------------------------------------------------------------------ hold


def test_hold_stops_jaws_that_move() -> None:
    led = Led(gripper())
    led.write(move(1.0))
    led.run(0.3)
    led.hold()
    led.run(0.1)
    stopped = led.sample.position
    assert led.settings[-1] == "SET GTO 0"
    led.run(1.0)
    assert led.sample.position == stopped < 0.5
    assert led.sample.velocity == 0.0


def test_hold_leaves_jaws_alone_that_press_on_something() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0, force_n=100.0))
    led.run(2.0)
    before = led.settings.copy()
    led.hold()
    led.run(1.0)
    assert led.settings == before
    assert led.gripper.figures()["force_n"] == pytest.approx(100.0, abs=1.0)
    assert led.sample.holds_object


def test_jaws_that_hold_are_stopped_where_what_they_held_slips_out() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0))
    led.run(2.0)
    led.hold()
    led.run(0.5)
    led.gripper.put(None)
    led.run(2.0)
    assert led.settings[-1] == "SET GTO 0"
    assert not led.sample.holds_object
    # 10 counts, and two readings at 1 /s.
    assert led.sample.position < CONTACT_40_MM + 10 * COUNT + 0.05


def test_jaws_that_hold_follow_what_gives_way() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0))
    led.run(2.0)
    led.hold()
    led.run(0.5)
    led.gripper.put(GrippedObject(width_m=38.0 * MM))
    led.run(2.0)
    assert len(led.settings) == 1
    assert led.sample.position == pytest.approx(1.0 - 38.0 / 85.0, abs=COUNT)
    assert led.gripper.figures()["force_n"] != 0.0
    assert led.sample.holds_object


@pytest.mark.parametrize(
    ("position", "stops"), [(0.9, False), (0.0, True)], ids=["presses on", "lets go"],
)  # fmt: skip
def test_hold_right_after_a_command_keeps_what_is_held(position: float, stops: bool) -> None:
    led = Led(gripper(40.0), round_trip_s=0.016)
    led.write(move(1.0))
    led.run(2.0)
    led.write(move(position))
    # The command was sent; since then the driver has read neither echo nor object.
    led.run(0.2, until=lambda _: len(led.settings) == 2)
    led.hold()
    led.run(0.1)
    assert (led.settings[-1] == "SET GTO 0") is stops
    led.run(1.0)
    if not stops:
        assert led.sample.holds_object
        assert led.sample.force_n > 0.0
    # The jaws open at most until the stop has arrived.
    assert led.sample.position == pytest.approx(CONTACT_40_MM, abs=0.06)


@given(
    st.lists(st.tuples(st.floats(0.4, 1.0), st.floats(0.0, 0.2)), min_size=1, max_size=20),
    st.sampled_from([0.002, 0.016, 0.06]),
)
def test_hold_never_lets_go_of_what_is_held(stream: list[tuple[float, float]], round_trip_s: float) -> None:
    led = Led(gripper(40.0), round_trip_s=round_trip_s)
    led.write(move(1.0))
    led.run(2.0)
    for position, duration_s in stream:
        led.write(move(position))
        led.run(duration_s)
    held = led.sample.holds_object
    led.hold()
    led.run(1.0)
    if held and min(position for position, _ in stream) > CONTACT_40_MM + COUNT:
        assert led.gripper.read("GTO") == 1
        assert led.gripper.figures()["force_n"] != 0.0
        assert led.sample.holds_object
    assert led.sample.velocity == 0.0


def test_hold_in_the_middle_of_a_stream_keeps_what_it_has_closed_on() -> None:
    # Each request resets OBJ to 0: in a dense stream OBJ never shows the contact.
    led = Led(gripper(40.0), answer=lambda request, value: MOVING if request.reads == "OBJ" else value)
    for step in range(350):
        led.write(move(0.002 * step))
        led.run(0.02)
    assert led.sample.holds_object
    before = led.settings.copy()
    led.hold()
    led.run(1.0)
    assert led.settings == before
    assert led.sample.holds_object
    # The driver reports the release as soon as a stream leads the jaws apart.
    for step in range(20):
        led.write(move(0.5 - 0.002 * step))
        led.run(0.02)
    assert not led.sample.holds_object


@pytest.mark.parametrize("towards", [0.0, 1.0])
def test_the_end_of_the_stroke_is_no_contact(towards: float) -> None:
    led = Led(gripper())
    led.write(move(0.5))
    led.run(1.0)
    for step in range(150):
        led.write(move(abs(1.0 - towards - min(1.0, 0.5 + 0.005 * step)), speed=0.3 + 0.01 * (step % 2)))
        led.run(0.02)
        assert not led.sample.holds_object


def test_hold_is_not_paced_and_not_held_up_by_commands() -> None:
    led = Led(gripper(), round_trip_s=0.016)
    led.write(move(1.0))
    led.run(0.3)
    led.write(move(0.9))
    led.run(0.5, until=lambda _: len(led.settings) == 2)
    led.hold()
    begun_s = led.now_s
    led.run(0.5, until=lambda _: led.settings[-1] == "SET GTO 0")
    assert led.now_s - begun_s <= 0.016 + CYCLE_S


def test_after_a_hold_the_next_command_moves() -> None:
    led = Led(gripper())
    led.write(move(1.0))
    led.run(0.3)
    led.hold()
    led.run(0.3)
    led.write(move(1.0))
    led.run(2.0)
    assert led.sample.position == 1.0
    assert led.settings[-1].endswith("GTO 1")


# ------------------------------------------------------------------------------------------------------------ pace


def test_the_newest_command_wins_and_no_more_are_sent_than_the_rate() -> None:
    led = Led(gripper(), rate_hz=50.0)
    for step in range(200):
        led.write(move(0.001 * step))
        led.run(0.005)
    # At most 50 Hz for 1 s; a stream of commands leaves room for readings.
    assert 25 <= len(led.settings) <= 51
    assert sum(request.reads == "POS" for _, request in led.requests) >= 25
    led.run(0.1)
    assert led.settings[-1].startswith(f"SET POS {round(3 + 0.199 * 227)} ")
    assert led.sample.fault is None


def test_the_same_command_again_is_not_sent_again() -> None:
    led = Led(gripper())
    for _ in range(50):
        led.write(move(0.4))
        led.run(0.02)
    assert len(led.settings) == 1


@pytest.mark.parametrize(("round_trip_s", "positions_hz"), [(0.002, 50.0), (0.016, 20.8), (0.1, 3.3)])
def test_a_slow_server_is_asked_less_often(round_trip_s: float, positions_hz: float) -> None:
    led = Led(gripper(), round_trip_s=round_trip_s)
    led.run(2.0)
    begun, duration_s = len(led.requests), 10.0
    led.run(duration_s)
    asked = led.requests[begun:]
    assert sum(request.reads == "POS" for _, request in asked) / duration_s == pytest.approx(positions_hz, rel=0.2)
    # This client takes at most two thirds of the time, so that others get served.
    assert len(asked) * round_trip_s < 0.67 * duration_s
    assert led.session.round_trip_s == pytest.approx(round_trip_s, abs=CYCLE_S)
    # The driver polls for faults as well.
    assert {request.reads for _, request in asked} == {"POS", "OBJ", "FLT", "STA"}


def test_requests_follow_one_another() -> None:
    led = Led(gripper(40.0), round_trip_s=0.01)
    led.write(move(1.0))
    led.run(3.0)
    assert all(later - earlier >= 0.01 - 1e-9 for (earlier, _), (later, _) in pairwise(led.requests))


@given(
    st.lists(st.tuples(st.one_of(st.none(), st.floats(0.0, 1.0)), st.floats(0.0, 0.5)), max_size=8),
    st.sampled_from([None, 20.0, 60.0]),
    st.sampled_from([0.002, 0.016, 0.06]),
)
def test_whatever_is_ordered(orders: list[tuple[float | None, float]], object_mm: float | None, trip_s: float) -> None:
    led = Led(gripper(object_mm), round_trip_s=trip_s)
    for position, duration_s in orders:
        if position is None:
            led.hold()
        else:
            led.write(move(position))
        led.run(duration_s)
    led.run(5.0)
    assert led.sample.fault is None
    assert led.sample.velocity == 0.0
    of = led.gripper
    assert led.sample.position == led.session._scale.position(of.read("POS") or 0)
    assert led.sample.holds_object == (of.read("GTO") == 1 and of.read("OBJ") in CONTACT)


# ---------------------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("flt", [5, *range(7, 16)])
def test_each_fault_is_named_and_stays_until_it_is_acknowledged(flt: int) -> None:
    led = Led(gripper())
    led.write(move(1.0))
    led.run(0.3)
    led.gripper.fail(flt)
    led.run(1.0, until=lambda sample: sample.fault is not None)
    first = led.sample.fault
    assert first is not None
    # The driver reads STA and FLT one after the other; either may show the fault first.
    assert first.startswith((f"FLT {flt}: ", "not active: STA 0: "))
    led.gripper.fail(0)
    led.run(1.0)
    assert led.sample.fault == first
    led.write(move(0.0))
    led.run(0.5)
    assert led.settings[-1] == "SET GTO 0"


def test_what_was_ordered_before_a_fault_is_not_followed_after_it() -> None:
    led = Led(gripper())
    led.gripper.fail(8)
    led.run(0.5)
    led.write(move(1.0))
    led.run(0.2)
    led.gripper.fail(0)
    led.session.acknowledge()
    led.run(1.0)
    assert led.settings == []
    assert led.sample.fault is None
    led.write(move(0.5))
    led.run(1.5)
    assert led.sample.position == pytest.approx(0.5, abs=COUNT)


def test_a_fault_that_goes_on_shows_again() -> None:
    led = Led(gripper())
    led.gripper.fail(8)
    led.run(0.5)
    led.session.acknowledge()
    led.run(0.5)
    assert led.sample.fault is not None


def test_a_fault_keeps_the_grip() -> None:
    led = Led(gripper(40.0))
    led.write(move(1.0, force_n=100.0))
    led.run(2.0)
    before = led.settings.copy()
    led.gripper.fail(8)
    led.run(1.0)
    assert led.sample.fault is not None
    assert led.sample.holds_object
    assert led.settings == before


def test_a_gripper_that_was_reset_by_somebody_is_a_fault() -> None:
    led = Led(gripper())
    led.gripper.write({"ACT": 0})
    led.run(1.0)
    assert led.sample.fault is not None
    assert led.sample.fault.startswith("not active: STA 0: ")
    assert "activate = true" in led.sample.fault


def never_echoes(request: Request, value: int | None) -> int | None:
    return 0 if request.reads == "PRE" else value


def test_a_request_that_is_not_taken_is_sent_again_and_is_then_a_fault() -> None:
    led = Led(gripper(), answer=never_echoes)
    led.write(move(0.5))
    took_s = led.run(3.0, until=lambda sample: sample.fault is not None)
    assert took_s == pytest.approx(ECHOED_NS / 1e9, abs=0.1)
    assert led.sample.fault is not None
    assert led.sample.fault.startswith("request not taken: PRE 0 for 1 s after POS 116: ")
    assert led.settings.count(led.settings[0]) == 4
    led.run(0.1)
    # The gripper may have taken it all the same.
    assert led.settings[-1] == "SET GTO 0"


def test_a_request_that_was_dropped_once_is_taken_the_second_time() -> None:
    of, dropped = gripper(), list[Request]()

    def drops_the_first(request: Request, value: int | None) -> int | None:
        if request.reads is None and not dropped:
            dropped.append(request)
            of.write({"POS": 0})
        return value

    led = Led(of, answer=drops_the_first)
    led.write(move(0.5))
    led.run(2.0)
    assert led.sample.fault is None
    assert led.sample.position == pytest.approx(0.5, abs=COUNT)
    assert len(led.settings) == 2


def test_a_stream_whose_echo_lags_is_no_fault() -> None:
    shown: list[int] = [0] * 6

    def lags(request: Request, value: int | None) -> int | None:
        if request.reads != "PRE" or value is None:
            return value
        shown.append(value)
        return shown[-6]

    led = Led(gripper(40.0), answer=lags)
    for step in range(230):
        led.write(move(0.3 + 0.003 * step))
        led.run(0.02)
        # This holds also while PRE never shows the newest request of the stream; the contact is at 0.53.
        assert led.sample.holds_object or step < 110
    assert led.sample.fault is None


def test_a_session_begins_with_what_the_gripper_does() -> None:
    before = Led(gripper(40.0))
    before.write(move(1.0, force_n=200.0))
    before.run(2.0)
    led = Led(before.gripper, begin_s=before.now_s)
    assert led.sample.holds_object
    assert led.sample.force_n > 150.0
    led.hold()
    led.run(0.5)
    assert led.settings == []


def test_a_contact_that_gto_does_not_speak_of_is_none() -> None:
    values = dict.fromkeys(START, 0) | {"STA": 3, "OBJ": CONTACT_OPENING, "POS": 100}
    session = Session(Led(gripper()).session._scale, 50.0, values, None, 0)
    assert not session.sample(0).holds_object
