"""Devices that exert a force by themselves, in live sides: the notice before `open`, and cases without a close."""

import os
import signal
from pathlib import Path

import pytest
from tests.devices.drivers import declared
from tests.devices.terminal import Terminal

pytestmark = pytest.mark.live

BEFORE = "it exerts force by itself as soon as it is open"
NOT_CLOSED = "is NOT known to be closed: it may still exert, switch it off"
SCENE = """
schema = 1
[master]
{driver}
mass_kg = 0.1
[slave]
{device}
"""


def side(tmp_path: Path, name: str, driver: str) -> Terminal:
    """Start a live side with a test driver on a terminal, without its peer."""
    group = f"haptether.{name}s"
    scene = tmp_path / "scene.toml"
    chosen = "driver" if name == "master" else "device"
    scene.write_text(SCENE.format(**{"driver": "", "device": "", chosen: f'{chosen} = "own"'}))
    address = ["--peer", "127.0.0.1:9"] if name == "master" else ["--listen", "127.0.0.1:0"]
    environment = declared(tmp_path, group, own=driver)
    return Terminal(
        environment, name, *address, "--insecure", "--scene", str(scene), "--patience-s", "1", "--realtime", "off"
    )


@pytest.mark.parametrize(
    ("name", "driver", "exerts"),
    [
        ("master", "BearsItself", True),
        ("master", "Stylus", False),
        ("slave", "ArmThatHolds", True),
        ("slave", "Arm", False),
    ],
)
def test_it_is_said_before_the_open(tmp_path: Path, name: str, driver: str, exerts: bool) -> None:
    terminal = side(tmp_path, name, driver)
    terminal.end()
    assert (BEFORE in terminal.printed) == exerts, terminal.printed
    assert NOT_CLOSED not in terminal.printed
    if exerts:
        assert terminal.printed.index(BEFORE) < terminal.printed.index("real time:")


@pytest.mark.parametrize(("name", "driver"), [("master", "HangsInOpenAndBearsItself"), ("slave", "ArmThatHangsInOpen")])
def test_an_open_that_hangs_is_not_said_to_have_ended(tmp_path: Path, name: str, driver: str) -> None:
    terminal = side(tmp_path, name, driver)
    terminal.until("opening [")
    os.kill(terminal.process.pid, signal.SIGINT)
    assert terminal.end() == 130
    assert NOT_CLOSED in terminal.printed
