"""`--port PORT` of the bus commands, as an alternative to their first argument."""

import os
from pathlib import Path

import pytest

from haptether.cli.dynamixel.calibrate import Calibrate
from haptether.cli.dynamixel.find import Find
from haptether.cli.entry import main, parse
from haptether.dynamixel.arm import ArmRefusedError, ArmSettings, ServoArm, ServoSettings


@pytest.mark.parametrize(
    "arguments",
    [
        ["/dev/a", "arm.toml", "--ids", "1", "2"],
        ["--port", "/dev/a", "arm.toml", "--ids", "1", "2"],
        ["arm.toml", "--port", "/dev/a", "--ids", "1", "2"],
        ["arm.toml", "--ids", "1", "2", "--port=/dev/a"],
    ],
)
def test_a_port_is_an_argument_or_an_option(arguments: list[str]) -> None:
    command = parse(["dynamixel", "calibrate", *arguments])
    assert isinstance(command, Calibrate)
    assert (command.port, str(command.path), command.ids) == ("/dev/a", "arm.toml", (1, 2))
    found = parse(["dynamixel", "find", *(each for each in arguments if each != "arm.toml")])
    assert isinstance(found, Find)
    assert (found.port, found.ids) == ("/dev/a", (1, 2))


@pytest.mark.parametrize("arguments", [["--port"], [], ["--port", "a", "--port", "b"]])
def test_a_port_that_is_missing_or_there_twice_is_refused(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["dynamixel", "find", *arguments])
    assert ended.value.code == 2


@pytest.mark.parametrize("kind", ["/dev/null", "folder", "file", "pipe"])
def test_a_path_that_is_no_serial_port_is_said_to_be_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    port = tmp_path / "port"
    if kind == "folder":
        port.mkdir()
    elif kind == "file":
        port.touch()
    elif kind == "pipe":
        os.mkfifo(port)
    else:
        port = Path(kind)
    arm = ServoArm(ArmSettings(port=str(port), servos=(ServoSettings(servo_id=1, model="XM430-W350"),)), lambda _: None)
    with pytest.raises(ArmRefusedError, match=r"port: is no serial port: /dev/serial/by-id"):
        arm.open()
    assert main(["dynamixel", "find", str(port)]) != 0
    assert f"{port}: is no serial port" in capsys.readouterr().err
