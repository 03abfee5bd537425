"""Control scripts without a client: late ones, those of an earlier run, and programs of other users."""

import json
import socket
import time
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from tests.ur.emulated import Emulated, emulator, free_host
from tests.ur.raw_rtde import Client
from tests.ur.stalls import anew_after_stalls
from tests.ur.watching import driven

from haptether.slave.ur.services import SCRIPT_PORT, ProbeError, end_control_script
from haptether.slave.ur_emulator.script.control_script import CONTROL_SCRIPT

pytestmark = [pytest.mark.live, pytest.mark.timeout(120)]

OTHER = "def other():\n  sleep(60)\nend"
SPEEDL, GET_TCP_OFFSET = 10, 40


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulated]:
    with emulator() as running:
        yield running


@pytest.fixture
def arm(shared: Emulated) -> Emulated:
    shared.do("reset")
    shared.do("in-use off")
    written(shared, 0)
    return shared


def sent(arm: Emulated, program: str) -> None:
    """Send a program like ur_rtde does."""
    with socket.create_connection((arm.host, SCRIPT_PORT), 5.0) as connection:
        connection.sendall(f"{program}\n".encode())
        # Closing a connection with unread bytes would reset it.
        time.sleep(0.05)


def written(arm: Emulated, command: int) -> None:
    """Write the command register, as a client that then dies."""
    with Client(arm.host) as client:
        recipe, _ = client.inputs(["input_int_register_0", *(f"input_double_register_{n}" for n in range(8))])
        client.outputs(["timestamp"])
        client.start()
        # 20 mm/s along z.
        client.write(recipe, "i8d", command, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0, 0.5, 0.1)
        for _ in range(5):
            client.package()


def command_register(arm: Emulated) -> int:
    with Client(arm.host) as client:
        client.outputs(["input_int_register_0"])
        client.start()
        return int(client.package()["input_int_register_0"])


class Row(NamedTuple):
    """A sent program, the command that a dead client left, and whether the program must end."""

    name: str
    program: str
    command: int
    ended: bool


ROWS = [
    Row("control script", CONTROL_SCRIPT, 0, ended=True),
    Row("in the middle of a command", CONTROL_SCRIPT, GET_TCP_OFFSET, ended=True),
    Row("moves the arm", CONTROL_SCRIPT, SPEEDL, ended=True),
    Row("program of somebody else", OTHER, 0, ended=False),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_only_a_control_script_without_a_client_is_ended(arm: Emulated, row: Row) -> None:
    sent(arm, row.program)
    arm.wait_for("runtime_state", "PLAYING")
    if row.command:
        written(arm, row.command)
    assert end_control_script(arm.host) == row.ended
    assert arm.status()["runtime_state"] == ("STOPPED" if row.ended else "PLAYING")
    assert command_register(arm) == (255 if row.ended else 0)


def test_a_script_that_starts_later_ends_at_once(arm: Emulated) -> None:
    arm.do("start-up 0.5")
    sent(arm, CONTROL_SCRIPT)
    assert end_control_script(arm.host)
    # The emulator names the program from its start on.
    arm.wait_for("program", "rtde_control")
    arm.wait_for("runtime_state", "STOPPED", patience_s=1.0)


def test_a_script_that_another_client_leads_goes_on(arm: Emulated) -> None:
    sent(arm, CONTROL_SCRIPT)
    arm.wait_for("runtime_state", "PLAYING")
    with Client(arm.host) as leader:
        assert leader.inputs(["input_int_register_0"])[1] == ["INT32"]
        with pytest.raises(ProbeError, match="another client leads the program that plays: end that client"):
            end_control_script(arm.host)
    assert arm.status()["runtime_state"] == "PLAYING"


class Start(NamedTuple):
    """Start-up time of the control script in s, and whether the arm is taken."""

    start_up_s: float
    taken: bool


@pytest.mark.sampled(1)
@pytest.mark.parametrize("row", [Start(3.0, taken=True), Start(5.9, taken=False)], ids=["waited for", "too late"])
@anew_after_stalls
def test_a_slow_script_is_waited_for_as_long_as_the_library_does_and_never_left(row: Start) -> None:
    pytest.importorskip("rtde_control")
    host = free_host()
    with emulator(host=host) as emulated:
        # State left by an earlier run.
        sent(emulated, CONTROL_SCRIPT)
        emulated.wait_for("runtime_state", "PLAYING")
        emulated.do(f"start-up {row.start_up_s}")
        with driven({"host": host, "verify_watchdog": False, "watchdog_hz": 5.0}) as watching:
            if row.taken:
                watching.wait_for("slave", "engaged", patience_s=15.0)
            else:
                event = watching.wait_for("error", since_s=1e-9, patience_s=15.0)
                while not event["error"]:
                    event = watching.wait_for("error", since_s=event["at_s"] + 1e-9, patience_s=15.0)
                assert "Failed to start control script" in event["error"]
            watching.end()
        end_s = time.monotonic() + 1.5
        while time.monotonic() < end_s:
            assert emulated.status()["runtime_state"] == "STOPPED"
            time.sleep(0.05)
        assert emulated.status()["program"] == "rtde_control"
        assert not [line for line in json.loads(emulated.do("log 100")) if "watchdog" in line]
