"""RTDE of the emulated controller, byte by byte and without a socket."""

import itertools
import math
import struct
from collections.abc import Iterable
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.ur.plain_rtde import frame

from haptether.slave.ur_emulator import ControllerVersion
from haptether.slave.ur_emulator.outbox import PATIENCE_S, Outbox
from haptether.slave.ur_emulator.rtde_frames import FramingError, text_message
from haptether.slave.ur_emulator.rtde_inputs import RtdeInputs
from haptether.slave.ur_emulator.rtde_session import RtdeSession
from haptether.slave.ur_emulator.rtde_variables import inputs_of, outputs_of

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.rtde_types import Value

E_SERIES = ControllerVersion(5, 11, 10, 108)
CB3 = ControllerVersion(3, 15, 8, 106339)


class Controller:
    """What connections share."""

    def __init__(self, version: ControllerVersion = E_SERIES) -> None:
        self.version = version
        self.inputs = RtdeInputs(inputs_of(version))
        self.types = outputs_of(version)
        self.outputs: dict[str, Value] = {name: kind.zero for name, kind in self.types.items()}
        self.log: list[str] = []
        self._numbers = iter(range(1, 100))

    def session(self, protocol: int = 2) -> RtdeSession:
        rate_hz = self.version.rate_hz
        number = next(self._numbers)
        session = RtdeSession(
            number, rate_hz, lambda: self.version, self.inputs, self.outputs, self.types, self.log.append
        )
        if protocol == 2:
            assert session.receive(frame("V", b"\x00\x02")) == frame("V", b"\x01")
        return session


def outputs_request(names: Iterable[str], rate_hz: float = 500.0) -> bytes:
    return frame("O", struct.pack(">d", rate_hz) + ",".join(names).encode())


def inputs_request(names: Iterable[str]) -> bytes:
    return frame("I", ",".join(names).encode())


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


def test_text_messages_have_the_layout_of_each_version() -> None:
    assert text_message("warning", "hot", 1) == frame("M", b"\x02hot")
    assert text_message("info", "hot", 2) == frame("M", b"\x03hot\x04RTDE\x03")


# ------------------------------------------------------------------------------------------------------ versions


@pytest.mark.parametrize(("asked", "accepted"), [(1, 1), (2, 1), (0, 0), (3, 0), (65535, 0)])
def test_protocol_versions(asked: int, accepted: int) -> None:
    session = Controller().session(protocol=1)
    assert session.receive(frame("V", struct.pack(">H", asked))) == frame("V", bytes([accepted]))
    assert session.protocol == (asked if accepted else 1)


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


# ------------------------------------------------------------------------------------------------------- outputs


@pytest.mark.parametrize("comma", ["", ","])
@pytest.mark.parametrize(("protocol", "head"), [(1, b""), (2, b"\x01")])
def test_outputs_are_set_up_with_and_without_a_trailing_comma(comma: str, protocol: int, head: bytes) -> None:
    session = Controller().session(protocol)
    rate = struct.pack(">d", 125.0) if protocol == 2 else b""
    request = frame("O", rate + b"timestamp,actual_q,robot_mode,actual_digital_input_bits" + comma.encode())
    assert session.receive(request) == frame("O", head + b"DOUBLE,VECTOR6D,INT32,UINT64")


def test_a_recipe_with_an_unknown_output_is_refused() -> None:
    session = Controller().session()
    answer = session.receive(outputs_request(["timestamp", "nothing"]))
    assert answer == frame("O", b"\x00DOUBLE,NOT_FOUND")
    assert session.receive(frame("S")) == frame("S", b"\x00")
    assert session.package() is None


@pytest.mark.parametrize("rate_hz", [0.0, 0.5, -1.0, math.nan, math.inf])
def test_a_rate_that_there_is_not_is_refused(rate_hz: float) -> None:
    answer = Controller().session().receive(outputs_request(["timestamp"], rate_hz))
    assert answer == frame("O", b"\x00DOUBLE")


def test_a_list_of_names_has_a_limit() -> None:
    names = ["actual_current_window"] * 100
    assert Controller().session().receive(outputs_request(names))[3] == 0
    assert Controller().session().receive(outputs_request(names[:90]))[3] == 1


def test_a_package_holds_the_values_in_their_order() -> None:
    controller = Controller()
    session = controller.session()
    controller.outputs |= {
        "actual_q": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
        "robot_mode": -1,
        "output_bit_register_64": True,
        "actual_digital_output_bits": 1 << 40,
        "joint_mode": (253,) * 6,
    }
    names = ["joint_mode", "robot_mode", "actual_q", "output_bit_register_64", "actual_digital_output_bits"]
    session.receive(outputs_request(names))
    answer = session.receive(frame("S"))
    first = struct.pack(">B6ii6d?Q", 1, *(253,) * 6, -1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, True, 1 << 40)
    # Clients wait for the first package right behind the answer.
    assert answer == frame("S", b"\x01") + frame("U", first)
    controller.outputs["robot_mode"] = 7
    package = session.package()
    assert package is not None
    assert package[4 + 24 : 4 + 28] == struct.pack(">i", 7)


def test_version_1_has_no_recipe_number_in_packages() -> None:
    session = Controller().session(protocol=1)
    session.receive(frame("O", b"timestamp"))
    assert session.receive(frame("S")) == frame("S", b"\x01") + frame("U", struct.pack(">d", 0.0))


@pytest.mark.parametrize(
    ("version", "names", "size"),
    [
        # What ur_rtde subscribes to, and the size of the frame that it then gets.
        (
            E_SERIES,
            ["timestamp", "robot_status_bits", "safety_status_bits", "runtime_state"]
            + [f"output_int_register_{n}" for n in range(3)]
            + [f"output_double_register_{n}" for n in range(6)],
            84,
        ),
        (
            ControllerVersion(5, 23),
            ["timestamp", "robot_status_bits", "safety_status_bits", "runtime_state"]
            + [f"output_int_register_{n}" for n in range(3)]
            + [f"output_double_register_{n}" for n in (*range(24), *range(36, 48))],
            324,
        ),
    ],
)
def test_frames_of_ur_rtde(version: ControllerVersion, names: list[str], size: int) -> None:
    session = Controller(version).session()
    session.receive(outputs_request([*names, ""]))
    session.receive(frame("S"))
    package = session.package()
    assert package is not None
    assert len(package) == size


@pytest.mark.parametrize(
    ("version", "rate_hz", "packages"),
    [(E_SERIES, 500.0, 500), (E_SERIES, 125.0, 125), (E_SERIES, 300.0, 300), (E_SERIES, 10.0, 10),
     (E_SERIES, 1000.0, 500), (CB3, 125.0, 125), (CB3, 500.0, 125), (CB3, 50.0, 50)],
)  # fmt: skip
def test_packages_come_at_the_rate_that_was_asked_for(
    version: ControllerVersion, rate_hz: float, packages: int
) -> None:
    session = Controller(version).session()
    session.receive(outputs_request(["timestamp"], rate_hz))
    session.receive(frame("S"))
    came = [session.package() is not None for _ in range(version.rate_hz)]
    assert sum(came) == packages
    at = [cycle for cycle, yes in enumerate(came) if yes]
    distances = [after - before for before, after in itertools.pairwise(at)]
    assert max(distances) - min(distances) <= 1


def test_after_a_stall_only_the_newest_package_is_sent() -> None:
    session = Controller().session()
    session.receive(outputs_request(["timestamp"], 250.0))
    session.receive(frame("S"))
    assert session.package(cycles=51) is not None
    # 25.5 packages were due: the half is kept, so that the next one comes on time.
    assert session.package() is not None
    assert session.package() is None


def test_packages_pause_and_start() -> None:
    session = Controller().session()
    assert session.receive(frame("S")) == frame("S", b"\x00")
    session.receive(outputs_request(["timestamp"]))
    assert session.package() is None
    session.receive(frame("S"))
    assert session.package() is not None
    assert session.receive(frame("P")) == frame("P", b"\x01")
    assert session.package() is None
    session.receive(frame("S"))
    assert session.package() is not None
    # Another recipe takes the place of the first, and waits for its own start.
    session.receive(outputs_request(["timestamp", "actual_q"]))
    assert session.package() is None


# -------------------------------------------------------------------------------------------------------- inputs


def test_recipes_are_numbered_and_may_share_variables() -> None:
    controller = Controller()
    session = controller.session()
    one = inputs_request(["input_int_register_0", "input_double_register_0"])
    two = inputs_request(["input_int_register_0"])
    assert session.receive(one) == frame("I", b"\x01INT32,DOUBLE")
    assert session.receive(two) == frame("I", b"\x02INT32")
    assert session.receive(inputs_request(["no_register"])) == frame("I", b"\x00NOT_FOUND")
    assert session.receive(two) == frame("I", b"\x03INT32")
    # Values persist until they are overwritten, by whichever recipe; nobody has to start before.
    session.receive(frame("U", struct.pack(">Bid", 1, 11, 0.5)))
    session.receive(frame("U", struct.pack(">Bi", 3, -4)))
    assert controller.inputs.values["input_int_register_0"] == -4
    assert controller.inputs.values["input_double_register_0"] == 0.5
    assert controller.inputs.writes["input_int_register_0"] == 2


def test_an_input_belongs_to_one_connection_until_that_ends() -> None:
    controller = Controller()
    first, second = controller.session(), controller.session()
    both = inputs_request(["input_int_register_0", "input_int_register_1"])
    assert first.receive(inputs_request(["input_int_register_0"]))[3] == 1
    assert second.receive(both) == frame("I", b"\x00IN_USE,INT32")
    # Of a refused recipe nothing is taken.
    assert first.receive(inputs_request(["input_int_register_1"])) == frame("I", b"\x02INT32")
    first.close()
    assert second.receive(both) == frame("I", b"\x01INT32,INT32")


def test_a_client_that_nobody_sees_can_hold_inputs() -> None:
    controller = Controller()
    first, second = controller.session(), controller.session()
    request = inputs_request(["input_int_register_0"])
    first.receive(request)
    controller.inputs.blocked = frozenset({"input_int_register_0"})
    assert second.receive(request) == frame("I", b"\x00IN_USE")
    assert first.receive(request) == frame("I", b"\x02INT32")
    first.close()
    assert second.receive(request) == frame("I", b"\x00IN_USE")
    controller.inputs.blocked = frozenset()
    assert second.receive(request) == frame("I", b"\x01INT32")


@pytest.mark.parametrize(
    ("packed", "value", "refused"),
    [
        (struct.pack(">Bid", 1, 5, 2.0), 5, 0),
        (struct.pack(">Bid6d", 1, 5, 2.0, *(9.0,) * 6), 5, 0),
        (struct.pack(">Bi", 1, 5), 0, 0),
        (struct.pack(">Bid", 2, 5, 2.0), 0, 0),
        (struct.pack(">Bid", 0, 5, 2.0), 0, 0),
        (struct.pack(">Bid", 1, 5, math.nan), 0, 1),
        (struct.pack(">Bid", 1, 5, -math.inf), 0, 1),
    ],
    ids=["right", "too long", "too short", "unknown recipe", "recipe 0", "not a number", "infinite"],
)
def test_packages_that_do_not_fit_change_nothing(packed: bytes, value: int, refused: int) -> None:
    controller = Controller()
    session = controller.session()
    session.receive(inputs_request(["input_int_register_0", "input_double_register_0"]))
    assert session.receive(frame("U", packed)) == b""
    assert controller.inputs.values["input_int_register_0"] == value
    assert controller.inputs.refused == refused


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
    assert not outbox.is_stalled(1.0 + PATIENCE_S)
    outbox.sent(1, 1.5)
    outbox.sent(0, 1.6)
    assert not outbox.is_stalled(1.5 + PATIENCE_S)
    assert outbox.is_stalled(1.7 + PATIENCE_S)
    outbox.sent(3, 3.0)
    assert not outbox.is_stalled(99.0)
