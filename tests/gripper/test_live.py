"""Process of the emulated controller with a gripper: several independent clients at once, and its driver."""

import re
import socket
import time
from collections.abc import Iterator

import pytest
from tests.gripper.gello import GelloClient
from tests.gripper.serving import until
from tests.gripper.virtual import move
from tests.ur.emulated import Emulated, emulator

from haptether.slave import RobotiqGripper

pytestmark = pytest.mark.live

PORT = 63352
PATIENCE_S = 10.0
CONTACT_40_MM = 1.0 - 40.0 / 85.0
COUNT_40_MM = 123


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulated]:
    with emulator("--gripper", "2f-85", "--gripper-object-mm", "40", "--gripper-active") as running:
        yield running


@pytest.fixture
def arm(shared: Emulated) -> Emulated:
    shared.do("reset")
    return shared


@pytest.fixture
def led(arm: Emulated) -> Iterator[RobotiqGripper]:
    of = RobotiqGripper(host=arm.host)
    of.open()
    yield of
    of.close()


def registers(arm: Emulated) -> dict[str, int]:
    values: dict[str, int] = arm.status()["gripper"]["registers"]
    return values


# --------------------------------------------------------------------------------------------- independent client


def test_a_client_as_gellos_activates_calibrates_and_grips() -> None:
    with emulator("--gripper", "2f-85") as running:
        client = GelloClient(running.host)
        client.activate()
        assert (client.lowest, client.highest) == (3, 230)
        assert client.move_and_wait(100, 255, 10) == (100, 3)
        # A request for the current position does not wait for an old status.
        assert client.move_and_wait(100, 255, 10) == (100, 3)
        running.do("gripper-object 40")
        assert client.move_and_wait(255, 255, 255) == (COUNT_40_MM, 2)
        assert client.move_and_wait(0, 255, 255) == (3, 3)
        client.close()


def test_a_client_as_gellos_beside_the_driver(arm: Emulated, led: RobotiqGripper) -> None:
    client = GelloClient(arm.host)
    for _ in range(5):
        led.write(move(1.0, speed=1.5))
        until(led, lambda sample: sample.holds_object)
        assert client.get_variable("OBJ") == 2
        led.write(move(0.0, speed=1.5))
        until(led, lambda sample: sample.position == 0.0)
        assert client.get_variable("POS") == 3
    client.close()


def asked(host: str, request: bytes) -> bytes:
    with socket.create_connection((host, PORT), 5.0) as client:
        client.settimeout(5.0)
        client.sendall(request)
        return client.recv(1024)


def test_urscript_reads_digits_of_their_width(arm: Emulated) -> None:
    for request, digits in ((b"GET OBJ", b"3"), (b"GET FLT", b"00"), (b"GET PRE", b"000"), (b"GET STA", b"3")):
        assert asked(arm.host, request) == digits
        assert asked(arm.host, request + b"\n") == request[4:] + b" " + str(int(digits)).encode()


def test_a_request_in_parts_is_one(arm: Emulated) -> None:
    with socket.create_connection((arm.host, PORT), 5.0) as client:
        client.settimeout(5.0)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # No part of the request is valid by itself.
        for part in (b"SET PO", b"S 9 SP", b"E 255\n"):
            client.sendall(part)
            time.sleep(0.03)
        assert client.recv(1024) == b"ack"
    assert (registers(arm)["PRE"], registers(arm)["SPE"]) == (9, 255)


def test_no_line_without_an_end_costs_more_than_its_connection(arm: Emulated) -> None:
    with socket.create_connection((arm.host, PORT), 5.0) as client:
        client.settimeout(5.0)
        try:
            client.sendall(b"x" * (1 << 16))
            assert client.recv(1024) == b""
        except ConnectionError:
            # The server closed the connection during the send.
            pass
    assert asked(arm.host, b"GET STA\n") == b"STA 3"
    assert any(re.search("gripper client: request of [0-9]+ bytes without an end", line) for line in log(arm))


def log(arm: Emulated) -> list[str]:
    return arm.do("log 20").split('", "')


def test_without_a_gripper_there_is_no_such_server() -> None:
    with emulator() as running, pytest.raises(ConnectionRefusedError):
        socket.create_connection((running.host, PORT), 5.0)


def test_the_port_is_any_that_is_free_where_it_is_0() -> None:
    from haptether.cli import main

    with emulator("--gripper", "2f-140", "--gripper-port", "0", "--gripper-active") as running:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((running.host, PORT), 5.0)
        # The first line names the port; a second process at the same address fails.
        assert main(["ur-emulator", "--host", running.host, "--gripper", "2f-85"]) == 1


# ----------------------------------------------------------------------------------------------- driver and faults


def test_it_picks_something_up(arm: Emulated, led: RobotiqGripper) -> None:
    led.write(move(1.0, speed=1.0, force_n=120.0))
    held = until(led, lambda sample: sample.holds_object)
    assert held.position == pytest.approx(CONTACT_40_MM, abs=0.01)
    assert arm.status()["gripper"]["force_n"] == pytest.approx(120.0, abs=1.0)
    # The object slips out.
    arm.do("gripper-object none")
    assert until(led, lambda sample: not sample.holds_object).fault is None
    until(led, lambda sample: sample.position == 1.0)


@pytest.mark.parametrize("flt", [5, 7, 8, 9, 10, 11, 12, 13, 14, 15])
def test_each_fault_of_the_gripper(arm: Emulated, led: RobotiqGripper, flt: int) -> None:
    arm.do(f"gripper-fault {flt}")
    fault = until(led, lambda sample: sample.fault is not None).fault
    assert fault is not None
    # The automatic release of open jaws has ended at once.
    assert fault.startswith((f"FLT {flt}: ", "not active: STA 0: ", "FLT 15: " if flt == 11 else f"FLT {flt}: "))
    led.write(move(1.0))
    time.sleep(0.2)
    assert registers(arm)["GTO"] == 0


@pytest.mark.parametrize(
    ("line", "undo", "said"),
    [
        ("drop gripper", "status", "connection lost: "),
        ("gripper-silent on", "gripper-silent off", "silence: no reply to "),
        ("freeze", "thaw", "silence: no reply to "),
    ],
)
def test_a_lost_controller(arm: Emulated, led: RobotiqGripper, line: str, undo: str, said: str) -> None:
    led.write(move(1.0, speed=1.5, force_n=100.0))
    until(led, lambda sample: sample.holds_object)
    arm.do(line)
    fault = until(led, lambda sample: sample.fault is not None).fault
    assert str(fault).startswith(said)
    arm.do(undo)
    before = arm.status()["gripper"]
    led.acknowledge()
    assert until(led, lambda sample: sample.fault is None).holds_object
    time.sleep(0.2)
    assert arm.status()["gripper"] == before
    assert before["force_n"] == pytest.approx(100.0, abs=1.0)


def test_a_controller_that_takes_no_connection_stays_a_fault(arm: Emulated, led: RobotiqGripper) -> None:
    arm.do("refuse on")
    arm.do("drop gripper")
    first = until(led, lambda sample: sample.fault is not None).fault
    led.acknowledge()
    until(led, lambda sample: sample.fault not in {None, first})
    arm.do("refuse off")
    led.acknowledge()
    until(led, lambda sample: sample.fault is None)


def test_the_arm_goes_on_beside_it(arm: Emulated, led: RobotiqGripper) -> None:
    from tests.ur.raw_rtde import Client

    with Client(arm.host) as plain:
        plain.outputs(["timestamp"], 500.0)
        plain.start()
        led.write(move(1.0))
        stamps = [plain.package()["timestamp"] for _ in range(100)]
    assert stamps[-1] - stamps[0] == pytest.approx(99 * 0.002, abs=0.05)
    until(led, lambda sample: sample.holds_object)
