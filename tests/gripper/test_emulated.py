"""The emulated gripper and the text protocol of its server, in virtual time."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.gripper.virtual import CYCLE_S, MM, gripper
from tests.ur.virtual import START, World

from haptether.slave import ROBOTIQ_MODELS, ur_model
from haptether.slave.ur_emulator import (
    Controller,
    ControllerSettings,
    ControllerVersion,
    ControlLine,
    EmulatedGripper,
    Faults,
    GrippedObject,
    GripperSettings,
    ToolEnvironment,
)
from haptether.slave.ur_emulator.connections import GRIPPER_PORT, GripperPeer, PeerFactory
from haptether.slave.ur_emulator.gripper.gripper import CONTACT_S, RELEASE_M_S
from haptether.slave.ur_emulator.gripper.port import MAX_REQUEST, SETTLED, answered

MOVING, OPENING, CLOSING, ARRIVED = range(4)


class Jaws:
    """An emulated gripper with its clock."""

    def __init__(self, of: EmulatedGripper) -> None:
        self.of = of
        self.now_s = 0.0

    def ask(self, request: str) -> str:
        return answered(self.of, request.encode(), bare=False).decode()

    def value(self, variable: str) -> int:
        return int(self.ask(f"GET {variable}").split()[1])

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / CYCLE_S)):
            self.now_s += CYCLE_S
            self.of.advance(self.now_s)

    def until(self, variable: str, value: int, limit_s: float = 10.0) -> float:
        """Wait until a variable has a value; return the time in s."""
        begun_s = self.now_s
        while self.value(variable) != value:
            assert self.now_s - begun_s < limit_s, self.of.figures()
            self.run(CYCLE_S)
        return self.now_s - begun_s


@pytest.fixture
def jaws() -> Jaws:
    return Jaws(gripper())


# ------------------------------------------------------------------------------------------------------------ text


@pytest.mark.parametrize(
    ("request_", "named", "bare"),
    [
        ("GET POS", "POS 3", "003"),
        ("GET PRE", "PRE 0", "000"),
        ("GET STA", "STA 3", "3"),
        ("GET OBJ", "OBJ 3", "3"),
        ("GET FLT", "FLT 0", "00"),
        ("GET ACT", "ACT 1", "1"),
        ("GET GTO", "GTO 0", "0"),
        ("GET ATR", "ATR 0", "0"),
        ("GET ADR", "ADR 1", "1"),
        ("GET ARD", "ARD 0", "0"),
        ("GET FOR", "FOR 0", "000"),
        ("GET SPE", "SPE 0", "000"),
        ("GET SID", "SID 9", "9"),
        # This answer is always bare.
        ("GET DST", "4", "4"),
        ("GET VER", "emulated", "emulated"),
        ("SET POS 100 SPE 255 FOR 10 GTO 1", "ack", "ack"),
        ("SET SID 9", "ack", "ack"),
        ("SET POS 007", "ack", "ack"),
    ],
)
def test_answers_by_the_end_of_line(request_: str, named: str, bare: str) -> None:
    assert answered(gripper(), request_.encode(), bare=False) == named.encode()
    assert answered(gripper(), request_.encode(), bare=True) == bare.encode()


@pytest.mark.parametrize(
    "request_",
    ["GET", "GET XYZ", "GET POS SPE", "get POS", "SET", "SET POS", "SET POS x", "SET POS 256", "SET POS -1",
     "SET POS 1.5", "SET PRE 1", "SET STA 3", "SET GTO 2", "SET POS 1 SPE", "SET POS 1000", "SET POS 5 GTO 7", "",
     "SET  POS 1", "hello", "GET POS\x00", "SET POS ١"],
)  # fmt: skip
def test_what_is_no_request_changes_nothing(request_: str) -> None:
    of = gripper()
    before = of.figures()
    assert answered(of, request_.encode(), bare=False) == b"?"
    assert of.figures() == before


def peer(of: EmulatedGripper | None = None) -> GripperPeer:
    return GripperPeer(of or gripper())


def test_each_request_has_a_reply_of_its_own() -> None:
    of = peer()
    assert of.receive(b"GET STA\nGET OBJ\r\n\nSET POS 9\nGET P") == (b"STA 3", True)
    assert [of.more() for _ in range(4)] == [b"OBJ 3", b"ack", b"", b""]
    assert of.receive(b"RE\n") == (b"PRE 9", True)


def test_a_request_without_an_end_of_line_is_one_once_none_comes() -> None:
    of = peer()
    assert of.receive(b"GET OBJ") == (b"", True)
    assert [of.package(1) for _ in range(SETTLED)] == [*[None] * (SETTLED - 1), b"3"]
    assert of.package(1) is None
    # The other half arrives in time, so the first was not a bare request.
    of.receive(b"GET POS")
    assert of.package(SETTLED - 1) is None
    assert of.receive(b"\n") == (b"POS 3", True)
    # The server does not wait forever for the rest of a request.
    of.receive(b"GET PO")
    assert of.package(1000) is None
    assert of.receive(b"S\n") == (b"POS 3", True)


def test_a_silent_server_takes_requests_and_says_nothing() -> None:
    grips = gripper()
    of = peer(grips)
    grips.silent = True
    assert of.receive(b"GET POS\nGET STA\n") == (b"", True)
    of.receive(b"GET OBJ")
    assert of.package(SETTLED) is None
    grips.silent = False
    assert of.receive(b"GET STA\n") == (b"STA 3", True)


def test_no_line_is_longer_than_it_may() -> None:
    of = peer()
    for _ in range(MAX_REQUEST // 8):
        of.receive(b"SET POS ")
    with pytest.raises(ValueError, match=f"must be at most {MAX_REQUEST}"):
        of.receive(b"SET POS ")


@given(st.lists(st.one_of(st.binary(max_size=80), st.sampled_from([b"GET POS\n", b"SET POS 9 GTO 1\n", b"GET"]))))
def test_whatever_a_client_sends(parts: list[bytes]) -> None:
    grips = gripper(40.0)
    of = peer(grips)
    for n, part in enumerate(parts):
        try:
            answers = [of.receive(part)[0]]
        except ValueError:
            return
        answers += [of.package(1) or b""]
        while answer := of.more():
            answers.append(answer)
        assert all(re.fullmatch(rb"|ack|\?|([A-Z]{3} )?[0-9]{1,3}|emulated", answer) for answer in answers)
        grips.advance(CYCLE_S * (n + 1))
        assert 0 <= (grips.read("POS") or 0) <= 255


# ------------------------------------------------------------------------------------------------------ activation


def test_it_begins_as_after_its_power_is_switched_on() -> None:
    jaws = Jaws(gripper(active=False))
    assert (jaws.value("ACT"), jaws.value("STA"), jaws.value("OBJ")) == (0, 0, 3)
    # The gripper does not move before activation.
    jaws.ask("SET POS 255 SPE 255 GTO 1")
    jaws.run(1.0)
    assert (jaws.value("POS"), jaws.value("PRE")) == (3, 255)


def test_activation_closes_and_opens_in_its_time() -> None:
    jaws = Jaws(gripper(active=False))
    jaws.ask("SET ACT 1")
    jaws.run(CYCLE_S)
    assert jaws.value("STA") == 1
    jaws.run(1.0 - CYCLE_S)
    assert jaws.value("POS") == 230
    assert jaws.until("STA", 3) == pytest.approx(1.0, abs=0.01)
    assert jaws.value("POS") == 3
    jaws.ask("SET ACT 0")
    assert jaws.value("STA") == 0


# ---------------------------------------------------------------------------------------------------------- motion


@pytest.mark.parametrize(
    ("model", "spe", "stroke_s"),
    [("2f-85", 255, 85 / 150), ("2f-85", 0, 85 / 20), ("2f-140", 255, 140 / 250), ("hand-e", 0, 50 / 20)],
)
def test_the_stroke_takes_as_long_as_its_maker_says(model: str, spe: int, stroke_s: float) -> None:
    jaws = Jaws(gripper(model=model))
    jaws.ask(f"SET POS 255 SPE {spe} FOR 0 GTO 1")
    jaws.run(CYCLE_S)
    assert jaws.value("OBJ") == MOVING
    assert jaws.until("OBJ", ARRIVED) == pytest.approx(stroke_s, abs=0.01)
    # The gripper stops short of the request, like a real one.
    assert jaws.value("POS") == 230


def test_the_echo_comes_at_once_and_the_object_status_with_it(jaws: Jaws) -> None:
    assert jaws.value("OBJ") == ARRIVED
    jaws.ask("SET POS 100")
    assert (jaws.value("PRE"), jaws.value("OBJ"), jaws.value("GTO")) == (100, MOVING, 0)
    jaws.run(1.0)
    # Without GTO the gripper stays, and so does the status that clients wait for.
    assert (jaws.value("POS"), jaws.value("OBJ")) == (3, MOVING)
    jaws.ask("SET SPE 255")
    jaws.ask("SET GTO 1")
    jaws.until("OBJ", ARRIVED)
    assert jaws.value("POS") == 100
    jaws.ask("SET POS 100")
    assert jaws.value("OBJ") == MOVING
    assert jaws.until("OBJ", ARRIVED) == pytest.approx(CYCLE_S)


def test_gto_stops(jaws: Jaws) -> None:
    jaws.ask("SET POS 255 SPE 128 GTO 1")
    jaws.run(0.3)
    jaws.ask("SET GTO 0")
    stopped = jaws.value("POS")
    jaws.run(1.0)
    assert jaws.value("POS") == stopped
    assert 3 < stopped < 230
    jaws.ask("SET GTO 1")
    jaws.until("POS", 230)


def count_of(width_mm: float) -> int:
    return round(230 - 227 * width_mm / 85)


def test_an_object_stops_the_jaws_and_is_noticed_after_a_while(jaws: Jaws) -> None:
    jaws.of.put(GrippedObject(width_m=40 * MM))
    jaws.ask("SET POS 255 SPE 255 FOR 255 GTO 1")
    jaws.until("POS", count_of(40))
    assert jaws.value("OBJ") == MOVING
    assert jaws.until("OBJ", CLOSING) == pytest.approx(CONTACT_S, abs=0.02)
    assert jaws.of.figures()["force_n"] == pytest.approx(235.0)
    # A further request against the object resets the object status.
    jaws.ask("SET POS 254")
    assert jaws.value("OBJ") == MOVING
    jaws.until("OBJ", CLOSING)
    # A request short of the object does not touch it.
    jaws.ask(f"SET POS {count_of(40) - 10}")
    jaws.until("OBJ", ARRIVED)
    assert jaws.of.figures()["force_n"] == 0.0


def test_an_object_that_is_lost_lets_the_jaws_close(jaws: Jaws) -> None:
    jaws.of.put(GrippedObject(width_m=40 * MM))
    jaws.ask("SET POS 255 SPE 255 FOR 255 GTO 1")
    jaws.until("OBJ", CLOSING)
    jaws.of.put(None)
    jaws.run(CYCLE_S)
    assert jaws.value("OBJ") == MOVING
    jaws.until("OBJ", ARRIVED)
    assert jaws.value("POS") == 230


def test_an_object_is_met_from_inside(jaws: Jaws) -> None:
    jaws.ask("SET POS 255 SPE 255 FOR 0 GTO 1")
    jaws.until("OBJ", ARRIVED)
    jaws.of.put(GrippedObject(width_m=30 * MM, inside=True))
    jaws.ask("SET POS 0")
    jaws.until("OBJ", OPENING)
    assert jaws.value("POS") == count_of(30)


def test_an_object_that_comes_too_late_is_not_met(jaws: Jaws) -> None:
    jaws.ask("SET POS 200 SPE 255 GTO 1")
    jaws.until("OBJ", ARRIVED)
    jaws.of.put(GrippedObject(width_m=40 * MM))
    jaws.ask("SET POS 255")
    jaws.until("OBJ", ARRIVED)
    assert jaws.value("POS") == 230
    # Jaws that have opened beyond the object meet it.
    jaws.ask("SET POS 0")
    jaws.until("OBJ", ARRIVED)
    jaws.ask("SET POS 255")
    jaws.until("OBJ", CLOSING)


def test_a_soft_object_yields_to_the_force(jaws: Jaws) -> None:
    # 20 N at a count of 0, 235 N at 255: 1 mm and 11.75 mm at 20 N/mm.
    jaws.of.put(GrippedObject(width_m=40 * MM, stiffness_n_per_m=20_000.0))
    jaws.ask("SET POS 255 SPE 255 FOR 0 GTO 1")
    jaws.until("OBJ", CLOSING)
    assert jaws.value("POS") == count_of(39.0)
    jaws.ask("SET FOR 255")
    jaws.run(1.0)
    assert (jaws.value("POS"), jaws.value("OBJ")) == (count_of(40.0 - 235.0 / 20.0), CLOSING)
    jaws.ask("SET FOR 0")
    jaws.run(1.0)
    # The object keeps its compression.
    assert (jaws.value("POS"), jaws.value("OBJ")) == (count_of(40.0 - 235.0 / 20.0), CLOSING)


@given(
    st.lists(
        st.one_of(
            st.tuples(st.sampled_from(["POS", "SPE", "FOR"]), st.integers(0, 255)),
            st.tuples(st.sampled_from(["ACT", "GTO", "ATR", "ADR", "ARD"]), st.integers(0, 1)),
            st.tuples(st.just("fault"), st.sampled_from([0, 5, 7, 8, 10, 14])),
            st.tuples(st.just("run"), st.integers(1, 400)),
        ),
        max_size=20,
    ),
    st.sampled_from([None, 5.0, 40.0, 85.0]),
)
def test_whatever_is_set_the_jaws_stay_in_their_stroke(steps: list[tuple[str, int]], object_mm: float | None) -> None:
    jaws = Jaws(gripper(object_mm))
    for name, value in steps:
        if name == "run":
            before = jaws.value("POS")
            jaws.run(CYCLE_S * value)
            # The speed is at most 150 mm/s, the largest, or that of an activation.
            assert abs(jaws.value("POS") - before) <= 150 / 85 * 227 * CYCLE_S * value + 1
        elif name == "fault":
            jaws.of.fail(value)
        else:
            assert jaws.ask(f"SET {name} {value}") == "ack"
        assert 3 <= jaws.value("POS") <= 230
        assert jaws.value("OBJ") in range(4)
        assert jaws.value("STA") in {0, 1, 3}


# ---------------------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("flt", [5, *range(7, 16)])
def test_a_fault_stops_the_jaws_until_it_ends(flt: int) -> None:
    jaws = Jaws(gripper())
    jaws.ask("SET POS 255 SPE 128 GTO 1")
    jaws.run(0.2)
    jaws.of.fail(flt)
    assert jaws.value("FLT") == flt
    assert jaws.value("STA") == (0 if flt in {7, 10} else 3)
    if flt == 11:
        # An automatic release moves the jaws.
        return
    stopped = jaws.value("POS")
    jaws.run(1.0)
    assert jaws.value("POS") == stopped
    jaws.ask("SET ACT 0")
    jaws.run(0.1)
    assert jaws.value("FLT") == flt
    jaws.ask("SET ACT 1")
    assert jaws.value("FLT") == 0
    jaws.until("STA", 3)


@pytest.mark.parametrize(("setting", "end"), [("ADR 1", 3), ("ADR 0", 230), ("ARD 0", 3), ("ARD 1", 230)])
def test_an_automatic_release_is_slow_and_ends_in_a_fault(setting: str, end: int) -> None:
    jaws = Jaws(gripper())
    jaws.ask("SET POS 116 SPE 255 GTO 1")
    jaws.until("OBJ", ARRIVED)
    jaws.ask(f"SET {setting}")
    jaws.ask("SET ATR 1")
    assert jaws.value("FLT") == 11
    assert jaws.until("FLT", 15) == pytest.approx(0.5 * 0.085 / RELEASE_M_S, abs=0.05)
    assert jaws.value("POS") == end
    jaws.ask("SET POS 100 GTO 1")
    jaws.run(1.0)
    assert jaws.value("POS") == end


@pytest.mark.parametrize(
    ("width_m", "stiffness", "said"),
    [(-0.001, 1.0, "width -0.001"), (float("nan"), 1.0, "must be finite"), (0.01, 0.0, "stiffness 0 N/m"),
     (0.086, 1.0, "86 mm: must be 0 to 85 mm: a 2f-85 opens no further")],
)  # fmt: skip
def test_an_object_that_cannot_be_is_refused(width_m: float, stiffness: float, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        gripper().put(GrippedObject(width_m=width_m, stiffness_n_per_m=stiffness))


# ------------------------------------------------------------------------------------------------------ controller


def controller() -> tuple[Controller, ControlLine]:
    grips = GripperSettings(model=ROBOTIQ_MODELS["2f-85"], grips=GrippedObject(width_m=0.04), active=True)
    settings = ControllerSettings(
        model=ur_model("ur5e"), version=ControllerVersion.parsed("5.11"), start=START, gripper=grips
    )
    environment = ToolEnvironment()
    of = Controller(settings, environment)
    return of, ControlLine(of, environment, Faults())


def test_it_moves_in_the_time_of_the_control_cycles() -> None:
    of, line = controller()
    client = PeerFactory(of).peer(GRIPPER_PORT)
    assert client.receive(b"SET POS 255 SPE 255 FOR 255 GTO 1\n") == (b"ack", True)
    for _ in range(250):
        of.cycle()
    assert client.receive(b"GET OBJ\n") == (b"OBJ 2", True)
    assert '"force_n": 235.0' in line.answer("status", 0.0)
    assert line.answer("reset", 0.0) == "ok"
    assert client.receive(b"GET POS\n") == (b"POS 3", True)


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("gripper-fault 9", "ok"),
        ("gripper-fault 6", "error: gripper-fault: 6: must be one of 0 5 7 8 9 10 11 12 13 14 15"),
        ("gripper-fault 8.5", "error: gripper-fault: 8.5: must be a whole number"),
        ("gripper-fault", "error: gripper-fault: '': must be 1 finite number"),
        ("gripper-object none", "ok"),
        ("gripper-object 30", "ok"),
        ("gripper-object 30 inside", "ok"),
        ("gripper-object 30 20", "ok"),
        ("gripper-object 90", "error: gripper-object: 90 mm: must be 0 to 85 mm: a 2f-85 opens no further"),
        ("gripper-object 30 0", "error: gripper-object: 0: must be positive"),
        ("gripper-object", "error: gripper-object: must be none, or a width in mm"),
        ("gripper-object inside", "error: gripper-object: must be none, or a width in mm"),
        ("gripper-object nan", "error: gripper-object: 'nan': must be 1 finite number"),
        ("gripper-silent on", "ok"),
        ("gripper-silent", "error: gripper-silent: must be on or off"),
        ("drop gripper", "ok"),
    ],
)
def test_control_lines(command: str, answer: str) -> None:
    _, line = controller()
    assert line.answer(command, 0.0).startswith(answer)


def test_control_lines_need_a_gripper() -> None:
    world = World(upload=False)
    for command in ("gripper-fault 9", "gripper-object none", "gripper-silent on"):
        assert "there is no gripper: begin with --gripper" in world.line.answer(command, 0.0)
    assert '"gripper": null' in world.line.answer("status", 0.0)
