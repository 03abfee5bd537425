"""The emulated bus byte for byte: the packets of the e-Manual, answering and silent servos, and garbage."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.dynamixel import SERVO_MODELS
from haptether.dynamixel.emulator import Bus, ControlLine, Servo
from haptether.dynamixel.emulator.protocol import HEADER, InstructionReader, crc16, status, stuffed, unstuffed

READ_POSITION = "84 00 04 00"


def made(*servos: tuple[int, str], firmware: int = 52) -> Bus:
    bus = Bus([Servo(SERVO_MODELS[name], number, firmware=firmware) for number, name in servos])
    bus.advance(0.0)
    return bus


@pytest.fixture
def bus() -> Bus:
    return made((1, "XM430-W210"), (2, "XM430-W210"))


def packet(servo_id: int, body: bytes) -> bytes:
    begin = HEADER + bytes((servo_id,)) + (len(stuffed(body)) + 2).to_bytes(2, "little") + stuffed(body)
    return begin + crc16(begin).to_bytes(2, "little")


def asked(bus: Bus, servo_id: int, body: str | bytes, now_s: float = 1.0) -> list[bytes]:
    """Return the servos' answers to an instruction with its parameters."""
    raw = bytes.fromhex(body) if isinstance(body, str) else body
    return [answer.sent for answer in bus.receive(packet(servo_id, raw), now_s)]


def error_of(answer: bytes) -> int:
    return answer[8]


# Source: ROBOTIS e-Manual, Protocol 2.0, the examples of the instructions.
def test_answers_are_those_of_the_manual() -> None:
    bus = made((1, "XM430-W210"), (2, "XM430-W210"), firmware=38)
    assert bus.receive(bytes.fromhex("FFFFFD00 01 0300 01 194E"), 1.0)[0].sent == bytes.fromhex(
        "FFFFFD00 01 0700 55 00 0604 26 655D"
    )
    bus.servo(1).voltage_v, bus.servo(2).temperature_c = 11.9, 36.0
    bulk = bytes.fromhex("FFFFFD00 FE 0D00 92 01 9000 0200 02 9200 0100 1A05")
    assert [answer.sent for answer in bus.receive(bulk, 2.0)] == [
        bytes.fromhex("FFFFFD00 01 0600 55 00 7700 C369"),
        bytes.fromhex("FFFFFD00 02 0500 55 00 24 8BA9"),
    ]


def test_a_fast_answer_is_that_of_the_manual() -> None:
    bus = Bus([Servo(SERVO_MODELS["XC330-T288"], number) for number in (3, 4, 7)])
    for number, ticks in ((3, 166), (7, 2079), (4, 1023)):
        servo = bus.servo(number)
        servo.joint.position_rad = (ticks - 2048) * 0.0015339807878856412
        servo.advance(0.0)
    (answer,) = bus.receive(bytes.fromhex("FFFFFD00 FE 0A00 8A 8400 0400 03 07 04 20F2"), 1.0)
    assert answer.sent == bytes.fromhex(
        "FFFFFD00 FE 1900 55 00 03 A6000000 8408 00 07 1F080000 16CA 00 04 FF030000 D19E"
    )


def test_firmware_without_fast_reads_is_silent() -> None:
    for name, first in (("XM430-W350", 45), ("XL330-M288", 46)):
        assert not asked(made((1, name), firmware=first - 1), 0xFE, f"8A {READ_POSITION} 01")
        assert asked(made((1, name), firmware=first), 0xFE, f"8A {READ_POSITION} 01")


def test_a_silent_servo_ends_the_answers_of_all_after_it(bus: Bus) -> None:
    whole = asked(bus, 0xFE, f"8A {READ_POSITION} 01 02")[0]
    bus.servo(2).silent = True
    assert asked(bus, 0xFE, f"8A {READ_POSITION} 01 02") == [whole[: 8 + 8]]
    assert len(asked(bus, 0xFE, f"82 {READ_POSITION} 01 02")) == 1
    assert not asked(bus, 0xFE, f"82 {READ_POSITION} 02 01")
    # It executes the instruction.
    assert not asked(bus, 2, "03 41 00 01")
    assert bus.servo(2).value("LED") == 1


@pytest.mark.parametrize(
    ("level", "answers"),
    [
        (0, {"01": 1, f"02 {READ_POSITION}": 0, "03 4100 01": 0}),
        (1, {"01": 1, f"02 {READ_POSITION}": 1, "03 4100 01": 0}),
    ],
)
def test_status_return_levels(bus: Bus, level: int, answers: dict[str, int]) -> None:
    # The write of the level itself is answered.
    assert len(asked(bus, 1, f"03 44 00 {level:02x}")) == 1
    assert {body: len(asked(bus, 1, body)) for body in answers} == answers


def test_nobody_answers_what_all_are_told(bus: Bus) -> None:
    assert not asked(bus, 0xFE, "03 41 00 01")
    assert [servo.value("LED") for servo in bus.servos] == [1, 1]
    assert not asked(bus, 0xFE, f"02 {READ_POSITION}")
    assert len(asked(bus, 0xFE, "01")) == 2
    assert not asked(bus, 0xFE, "08")
    assert [servo.restarts for servo in bus.servos] == [1, 1]


@pytest.mark.parametrize(
    ("body", "error"),
    [("77", 2), ("05", 2), ("02 84 00", 5), ("03 84", 5), ("03 41 00 02", 4), ("10 01 44 58 4C 22", 0), ("10 01", 4)],
)
def test_what_is_refused(bus: Bus, body: str, error: int) -> None:
    (answer,) = asked(bus, 1, body)
    assert error_of(answer) == error


def test_a_wrong_checksum_is_answered_and_changes_nothing(bus: Bus) -> None:
    broken = bytearray(packet(1, bytes.fromhex("03 41 00 01")))
    broken[-1] ^= 1
    (answer,) = bus.receive(bytes(broken), 1.0)
    assert error_of(answer.sent) == 3
    assert bus.servo(1).value("LED") == 0
    assert (bus.instructions, bus.refused) == (0, 1)


def test_a_new_id_counts_from_the_next_instruction_on(bus: Bus) -> None:
    (answer,) = asked(bus, 1, "03 07 00 05")
    assert answer[4] == 1
    assert not asked(bus, 1, "01")
    assert len(asked(bus, 5, "01")) == 1


def test_a_shadow_obeys_and_is_silent(bus: Bus) -> None:
    assert asked(bus, 2, "03 0C 00 01")
    assert [answer[4] for answer in asked(bus, 1, "03 41 00 01")] == [1]
    assert [servo.value("LED") for servo in bus.servos] == [1, 1]


def test_servos_hear_only_their_own_rate(bus: Bus) -> None:
    ping = packet(1, b"\x01")
    assert not bus.receive(ping, 1.0, baud=1_000_000)
    assert bus.receive(ping, 1.0, baud=57_600)


def test_a_sync_write_that_is_refused_is_seen_in_the_log_only(bus: Bus) -> None:
    assert not asked(bus, 0xFE, "83 66 00 02 00 01 FF 7F 02 0A 00")
    assert bus.servo(2).value("Goal Current") == 10
    assert list(bus.log) == ["id 1 refused a write to 102: data_limit"]


def test_a_brown_out_makes_them_start_anew(bus: Bus) -> None:
    asked(bus, 0xFE, "03 40 00 01")
    bus.brown_out(0.5, 2.0)
    assert not asked(bus, 1, "01", 2.4)
    assert len(asked(bus, 1, "01", 2.5)) == 1
    assert not bus.servo(1).torque


def test_a_packet_that_does_not_go_on_is_forgotten() -> None:
    reader = InstructionReader()
    whole = packet(1, b"\x01")
    assert not reader.receive(whole[:-1], 0.0)
    assert len(reader.receive(whole, 1.0)) == 1
    assert reader.dropped == len(whole) - 1


@given(st.binary(max_size=60), st.lists(st.integers(1, 20), min_size=1, max_size=5))
def test_instructions_come_in_any_pieces(body: bytes, sizes: list[int]) -> None:
    sent = packet(9, b"\x03" + body) * 2
    reader = InstructionReader()
    found = []
    at = 0
    while at < len(sent):
        size = sizes[at % len(sizes)]
        found += reader.receive(sent[at : at + size], 0.0)
        at += size
    assert [(one.id, one.code, one.parameters, one.valid) for one in found] == [(9, 3, body, True)] * 2


@given(st.lists(st.sampled_from([b"\xff", b"\xfd", b"\x00", b"\xff\xff\xfd", b"\x55"])).map(b"".join))
def test_stuffing_comes_off_again(body: bytes) -> None:
    assert unstuffed(stuffed(body)) == body
    assert b"\xff\xff\xfd\x00" not in stuffed(body)


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=30),
            st.builds(packet, st.integers(0, 255), st.binary(min_size=1, max_size=30)),
            st.builds(
                lambda code, rest: packet(0xFE, bytes((code,)) + rest),
                st.sampled_from([0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A]),
                st.binary(max_size=30),
            ),
        ),
        max_size=20,
    )
)
def test_garbage_does_no_harm(pieces: list[bytes]) -> None:
    bus = made((1, "XM430-W210"), (2, "XL330-M288"))
    now_s = 0.0
    for piece in pieces:
        now_s += 0.05
        for answer in bus.receive(piece, now_s):
            assert answer.sent.startswith(HEADER)
            assert len(answer.sent) <= 1024 + 256
    now_s += 1.0
    assert bus.reader.receive(b"", now_s) == []
    assert len(bus.receive(packet(0xFE, b"\x01"), now_s + 1.0)) == 2


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("nonsense", "error: 'nonsense': must be one of brown-out"),
        ("", "error: an empty line: must be one of"),
        ("silent", "error: silent: the first must be the id of a servo"),
        ("silent 3 on", "error: silent: id 3: must be one of 1, 2"),
        ("silent 1 perhaps", "error: silent: must be an id, and on or off"),
        ("drop 0", "ok"),
        ("drop -1", "error: drop: -1: must be a whole number, 0 to"),
        ("corrupt nan", "error: corrupt: 'nan': must be 1 finite number"),
        ("brown-out -1", "error: brown-out: -1: must be 0 to 3600 s"),
        ("hardware-error 1 fire", "error: hardware-error: must be an id and one of input-voltage overheating"),
        ("voltage inf", "error: voltage: 'inf': must be 1 finite number"),
        ("temperature 1 300", "error: temperature: 300: must be 0 to 255 degC"),
        ("push 1 1e9", "error: push: 1e+09: must be at most 1000 N m"),
        ("place 1 -2000", "error: place: -2000: must be at most 1000 rad"),
        ("unplug", "error: unplug: there is no port"),
        ("reset", "error: reset: the bus cannot be made a second time"),
        ("help", "ok brown-out corrupt drop"),
        ("push 1 0.5", "ok"),
        ("place 2 0.25", "ok"),
        ("voltage 12.5 1", "ok"),
        ("hardware-error 2 encoder", "ok"),
        ("quit", "ok"),
    ],
)
def test_control_lines(bus: Bus, line: str, said: str) -> None:
    assert ControlLine(bus).answer(line, 1.0).startswith(said)


def test_control_lines_act(bus: Bus) -> None:
    line = ControlLine(bus)
    for command in ("place 2 0.25", "voltage 12.5 1", "hardware-error 2 electrical-shock", "silent 1 on", "corrupt 2"):
        assert line.answer(command, 1.0) == "ok"
    one, two = bus.servos
    assert (one.voltage_v, two.voltage_v) == (12.5, 12.0)
    assert (one.silent, two.joint.position_rad) == (True, 0.25)
    assert two.value("Hardware Error Status") == 0x10
    intact = status(2, 0x80, (2048 + 163).to_bytes(4, "little"))
    answers = [asked(bus, 2, f"02 {READ_POSITION}", 2.0 + n)[0] for n in range(3)]
    assert [answer == intact for answer in answers] == [False, False, True]


@pytest.mark.parametrize(
    ("servos", "said"),
    [([], "servos: must be at least one"), ([(4, "XM430-W350"), (4, "XL330-M288")], "id 4 is given twice")],
)
def test_impossible_buses_are_refused(servos: list[tuple[int, str]], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        made(*servos)
