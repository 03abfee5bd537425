"""Process of an emulated bus: its refusals, its end, its port, and its time on the wire."""

import json
import signal
import time
from pathlib import Path

import pytest
from tests.dynamixel.emulated import emulated_bus, vendor_client

from haptether.cli import main

pytestmark = pytest.mark.live


@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "end of input"])
def test_it_ends_cleanly(how: str, tmp_path: Path) -> None:
    link = tmp_path / "bus"
    with emulated_bus("--link", str(link)) as running:
        assert running.port == str(link)
        assert link.readlink().exists()
        assert running.process.stdin is not None
        if how == "end of input":
            running.process.stdin.close()
        else:
            running.process.send_signal(signal.Signals[how])
        assert running.process.wait(5.0) == 0
        assert not link.is_symlink()


def test_a_reset_makes_all_as_at_the_start() -> None:
    with emulated_bus("--servos", "1=XM430-W350", "--start", "0.3", "--stops", "1=0.2:0.8") as running:
        before = running.status()
        for line in ("place 1 0.7", "voltage 9 1", "silent 1 on", "hardware-error 1 overload"):
            running.do(line)
        assert running.status() != before
        running.do("reset")
        assert running.status() == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--servos", "1"], "servos = 1: must be ID=MODEL with a model of XL330-M077"),
        (["--servos", "1=XM430"], "servos = 1=XM430: must be ID=MODEL"),
        (["--servos", "300=XM430-W350"], "id 300: must be 0 to 252"),
        (["--servos", "1=XM430-W350", "1=XL330-M288"], "id 1 is given twice"),
        (["--servos", "1=XL330-M288", "--baud", "4500000"], "baud = 4500000: a XL330-M288 must have one of 9600"),
        (["--firmware", "300"], "firmware = 300: must be 0 to 255"),
        (["--start", "0.5"], "start: 1 angles: must be 7"),
        (["--servos", "1=XM430-W350", "--start", "nan"], "start = nan: must be at most 1000 rad"),
        (["--return-delay", "255"], "return_delay = 255: must be 0 to 254"),
        (["--latency-ms", "-1"], "latency_ms = -1: must be 0 to 1000 ms"),
        (["--control", "192.0.2.1:9000"], "control = "),
        (["--seed", "-1"], "seed = -1"),
        (["--stops", "1"], "stops = 1: '': must be 2 finite numbers"),
        (["--stops", "1=0.1:nan"], "stops = 1=0.1:nan: '0.1 nan': must be 2 finite numbers"),
        (["--stops", "1=0.1:0.1"], "stops = 1=0.1:0.1: 0.1 0.1: must be two angles within 1000 rad"),
        (["--stops", "x=0:1"], "stops = x=0:1: must be ID=A:B or ID=A:B:K"),
        (["--stops", "1=0:1:0"], "stops = 1=0:1:0: 0: stiffness must be above 0 and at most 4100 N m/rad"),
        (["--stops", "1=0:1:9:-1"], "stops = 1=0:1:9:-1: -1: damping must be 0 to 10000 N m s/rad"),
        (["--stops", "1=0:1:9:1:1"], "stops = 1=0:1:9:1:1: '1 1': must be 1 finite number"),
        (["--stops", "9=0:1"], "stops = 9=0:1: id 9: must be one of 1, 2, 3"),
    ],
)
def test_bad_requests_are_refused(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dynamixel-emulator", "--duration-s", "1", *arguments]) == 2
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1


def test_the_link_of_another_bus_is_left_to_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = tmp_path / "bus"
    with emulated_bus("--link", str(link)) as running:
        terminal = link.readlink()
        assert main(["dynamixel-emulator", "--duration-s", "1", "--link", str(link)]) == 1
        assert f"{link}: leads to {terminal}, which is in use: name another, or remove it" in capsys.readouterr().err
        assert link.readlink() == terminal
        # The emulator leaves a link that a user has pointed elsewhere.
        link.unlink()
        link.symlink_to("/dev/null")
        running.process.send_signal(signal.SIGINT)
        assert running.process.wait(5.0) == 0
    assert link.readlink() == Path("/dev/null")


def test_a_link_that_a_killed_bus_left_behind_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "bus"
    link.symlink_to("/dev/pts/no-terminal")
    with emulated_bus("--link", str(link)):
        assert link.exists()


def test_a_link_over_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "file"
    file.write_text("kept")
    assert main(["dynamixel-emulator", "--duration-s", "1", "--link", str(file)]) == 1
    assert "exists and is no symbolic link" in capsys.readouterr().err
    assert file.read_text() == "kept"


def test_state_at_the_end_as_json(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    arguments = ["--servos", "3=XL330-M288", "--start", "0.5", "--duration-s", "0.2", "--json", str(path)]
    assert main(["dynamixel-emulator", *arguments]) == 0
    (servo,) = json.loads(path.read_text())["servos"]
    assert (servo["id"], servo["model"], servo["position_rad"], servo["torque"]) == (3, "XL330-M288", 0.5, False)


def test_the_link_stays_the_same_when_it_is_plugged_anew(tmp_path: Path) -> None:
    link = tmp_path / "bus"
    with emulated_bus("--servos", "1=XM430-W350", "--link", str(link)) as running:
        running.do("unplug")
        assert not link.is_symlink()
        assert running.do("plug") == str(link)
        with vendor_client(str(link)) as client:
            assert client.packets.ping(client.port, 1)[0] == 1020


def test_time_on_the_wire() -> None:
    # At 57600 bit/s 14 bytes there and 15 back take 5 ms, the return delay 0.5 ms, the latency timer 10 ms.
    arguments = ["--servos", "1=XM430-W350", "--baud", "57600", "--wire-time", "--return-delay", "250"]
    with emulated_bus(*arguments, "--latency-ms", "10") as running, vendor_client(running.port, 57_600) as client:
        begun = time.monotonic()
        for _ in range(20):
            assert client.read(1, 132, 4) == (2048, 0, 0)
        assert time.monotonic() - begun >= 20 * 0.0155
