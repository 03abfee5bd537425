"""Recipes of RTDE with the emulated controller, byte by byte: outputs, rates and inputs."""

import itertools
import math
import struct

import pytest
from tests.ur.raw_rtde import frame
from tests.ur.sessions import CB3, E_SERIES, Controller, inputs_request, outputs_request

from haptether.slave.ur_emulator import ControllerVersion

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
        # Subscriptions of ur_rtde, and the size of their frame.
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
    due = [session.package() is not None for _ in range(version.rate_hz)]
    assert sum(due) == packages
    at = [cycle for cycle, yes in enumerate(due) if yes]
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
    # Another recipe replaces the first, and waits for its own start.
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
    # Values persist until they are overwritten, by any recipe; inputs need no start.
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
    # A refused recipe reserves nothing.
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
