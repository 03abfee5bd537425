"""RTDE of the emulated controller, byte by byte and without a socket: framing, versions, and the send queue."""

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.ur.raw_rtde import frame
from tests.ur.sessions import CB3, Controller, inputs_request, outputs_request

from haptether.slave.ur_emulator import ControllerVersion
from haptether.slave.ur_emulator.connections import READ_TIMEOUT_S, Outbox
from haptether.slave.ur_emulator.rtde.frames import FramingError
from haptether.slave.ur_emulator.rtde.variables import outputs_of

# ----------------------------------------------------------------------------------------------------- framing


CONVERSATION = (
    frame("V", b"\x00\x02")
    + frame("v")
    + outputs_request(["timestamp", "actual_q"])
    + inputs_request(["input_int_register_0", "input_double_register_0"])
    + frame("S")
    + frame("U", struct.pack(">Bid", 1, 7, 0.25))
    + frame("P")
)


@given(st.lists(st.integers(1, len(CONVERSATION) - 1), max_size=20))
def test_answers_do_not_depend_on_where_the_stream_is_cut(cuts: list[int]) -> None:
    whole, cut = Controller(), Controller()
    expected = whole.session(protocol=1).receive(CONVERSATION)
    session, answered = cut.session(protocol=1), b""
    edges = [0, *sorted(set(cuts)), len(CONVERSATION)]
    for begin, end in itertools.pairwise(edges):
        answered += session.receive(CONVERSATION[begin:end])
    assert answered == expected
    assert cut.inputs.values == whole.inputs.values
    assert cut.inputs.values["input_int_register_0"] == 7


@given(st.binary(max_size=200))
def test_noise_is_answered_refused_or_ignored(noise: bytes) -> None:
    session = Controller().session()
    try:
        session.receive(noise)
    except FramingError:
        assert any(int.from_bytes(noise[at : at + 2], "big") < 3 for at in range(len(noise)))


@pytest.mark.parametrize("size", [0, 1, 2])
def test_a_frame_shorter_than_its_header_ends_the_connection(size: int) -> None:
    with pytest.raises(FramingError, match=f"{size} bytes"):
        Controller().session().receive(struct.pack(">HB", size, ord("v")))


def test_unknown_frames_and_messages_are_not_answered() -> None:
    controller = Controller()
    session = controller.session()
    assert session.receive(frame("R", b"v1.software.version")) == b""
    assert session.receive(frame("M", b"\x05hello\x02me\x03")) == b""
    assert controller.log == ["hello"]
    assert session.receive(frame("M", b"\xffshort") + frame("U") + frame("V", b"\x02")) == b""


# ------------------------------------------------------------------------------------------------------ versions


@pytest.mark.parametrize(("requested", "accepted"), [(1, 1), (2, 1), (0, 0), (3, 0), (65535, 0)])
def test_protocol_versions(requested: int, accepted: int) -> None:
    session = Controller().session(protocol=1)
    assert session.receive(frame("V", struct.pack(">H", requested))) == frame("V", bytes([accepted]))
    assert session.protocol == (requested if accepted else 1)


def test_the_controller_says_its_version() -> None:
    answer = Controller(CB3).session().receive(frame("v"))
    assert answer == frame("v", struct.pack(">4I", 3, 15, 8, 106339))


@pytest.mark.parametrize(
    ("name", "has"),
    [
        ("actual_q", {"3.15", "5.4", "5.11", "5.23"}),
        ("payload", {"3.15", "5.11", "5.23"}),
        ("tcp_offset", {"3.15", "5.11", "5.23"}),
        ("ft_raw_wrench", {"5.11", "5.23"}),
        ("payload_inertia", {"3.15", "5.11", "5.23"}),
        ("actual_current_as_torque", {"5.23"}),
        ("output_double_register_47", {"3.15", "5.4", "5.11", "5.23"}),
        ("output_double_register_48", set()),
        ("actual_Q", set()),
    ],
)
def test_outputs_come_with_versions(name: str, has: set[str]) -> None:
    assert {v for v in ("3.15", "5.4", "5.11", "5.23") if name in outputs_of(ControllerVersion.parsed(v))} == has


@pytest.mark.parametrize("text", ["5", "5.x", "4.0", "5.3", "5.27", "3.14", "10.9", "5.11.0.0.0", ""])
def test_versions_that_are_not_emulated(text: str) -> None:
    with pytest.raises(ValueError, match="version = "):
        ControllerVersion.parsed(text)


# ------------------------------------------------------------------------------------------------------- sending


def test_data_packages_are_skipped_while_others_wait() -> None:
    outbox = Outbox()
    outbox.package(b"one", 0.0, 0.0)
    outbox.sent(1, 0.0)
    outbox.package(b"two", 0.002, 0.002)
    assert (bytes(outbox.ready), outbox.skipped) == (b"ne", 1)
    outbox.answer(b"answer")
    assert bytes(outbox.ready) == b"neanswer"


def test_late_packages_keep_their_order() -> None:
    outbox = Outbox()
    outbox.package(b"a", 0.010, 0.0)
    outbox.package(b"b", 0.0, 0.002)
    outbox.release(0.009)
    assert not outbox.ready
    outbox.release(0.010)
    assert bytes(outbox.ready) == b"ab"


def test_who_reads_nothing_is_stalled_after_a_while() -> None:
    outbox = Outbox()
    outbox.answer(b"much")
    outbox.sent(0, 1.0)
    assert not outbox.is_stalled(1.0 + READ_TIMEOUT_S)
    outbox.sent(1, 1.5)
    outbox.sent(0, 1.6)
    assert not outbox.is_stalled(1.5 + READ_TIMEOUT_S)
    assert outbox.is_stalled(1.7 + READ_TIMEOUT_S)
    outbox.sent(3, 3.0)
    assert not outbox.is_stalled(99.0)
