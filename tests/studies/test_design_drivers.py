"""`haptether check` judges drivers like `haptether master` and `slave` do at their start."""

import json
import re
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from haptether.bridge import load_scene, override_scene
from haptether.bridge.devices.open import DeviceError, check_force
from haptether.bridge.devices.scene import slave_drivers
from haptether.cli import main
from haptether.master import MasterSample
from haptether.studies import check_scene

ROOT = Path(__file__).resolve().parents[2]
OF_UR = ["slave.device=ur", "slave.options.host=192.0.2.1"]
THREE = "three_axis_box"
MASTERS: dict[str, tuple[str, list[str], str]] = {
    "no such driver": ("LEADER", ["master.driver=dynamixl"], "no such driver (haptether.masters): did you mean"),
    "no such option": ("LEADER", ["master.options.kd=3"], "kd = 3: is no option: must be one of port, arm"),
    "an option out of range": ("LEADER", ["master.options.force_share=7"], "force_share = 7: must be 0.1 to 1"),
    "an option of another type": ("LEADER", ["master.options.port=3"], "port = 3: must be a string"),
    "a file that is not there": ("LEADER", ["master.options.arm=nope"], "arm = 'nope': nope: No such file"),
    "options that differ": ("LEADER", ["master.options.offsets=[0,0]"], "must be 6 numbers, one of each joint"),
    "an option that is missing": ("LEADER", ["master.options={arm='gello-ur'}"], "port is missing"),
    "another number of joints": ("LEADER", ["master.axes=5", "master.mass_kg=0.1"], "6 axes, the scene 5"),
    "another number of axes": ("remote_push", ["master.driver=inverse3"], "has 3 axes, the scene 1"),
    "another kind": ("remote_push", ["master.driver=bench", "master.options.kinds=['pose']"], 'must be of "linear"'),
    "another period": ("remote_push", ["master.driver=bench", "master.options.period_s=0.002"], "set [run] period_s"),
    "a slow bus": ("remote_push", ["master.driver=bench", "master.options.cycle_s=0.002"], "must be at least 0.002"),
    "no trigger to be felt": ("felt_trigger", ["master.driver=bench", "master.options.axes=3"], "has no write_trigger"),
    "a constructor that fails": ("remote_push", ["master.driver=bench", "master.options.axes=0"], "ZeroDivisionError"),
}
SLAVES: dict[str, tuple[str, list[str], str]] = {
    "no such driver": (THREE, ["slave.device=urr"], "no such driver (haptether.slaves): did you mean ur?"),
    "no such option": (THREE, [*OF_UR, "slave.options.hosts=a"], "hosts = 'a': is no option"),
    "an option out of range": (THREE, [*OF_UR, "slave.options.max_speed=-1"], "max_speed = -1: must be"),
    "an option that is missing": (THREE, ["slave.device=ur"], "host is missing"),
    "another number of axes": ("remote_push", [*OF_UR, "slave.options.axes=3"], "has 3 axes, the scene 1"),
    "no forces": ("remote_push", [*OF_UR, "slave.takes_force=true"], "UrSlave takes only motions with these options"),
    "a file that is not there": (THREE, ["slave.device=dynamixel", "slave.options={port='x', arm='y'}"], "arm = 'y'"),
    "a gripper at a model": (THREE, ["slave.gripper={device='robotiq', options={host='a'}, force_n=5}"], "too"),
    "no such gripper": ("ur_pick", ["slave.gripper.device=robotix"], "no such driver (haptether.grippers)"),
    "no such option of a gripper": ("ur_pick", ["slave.gripper.options.grip=3"], "grip = 3: is no option"),
    "a modelled gripper at an arm": ("ur_pick", ["slave.gripper={force_n=5}"], "device = simulated"),
}


class Bench:
    """A haptic device that is never opened."""

    axes = 1

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # options of the case
        self.paces = "period_s" in options
        for name, value in options.items():
            setattr(self, name, tuple(value) if isinstance(value, list) else value)
        self.share = 1 / self.axes

    def open(self) -> None:
        raise AssertionError("opened")

    def read(self) -> MasterSample:
        raise AssertionError("read")

    def write(self, force: tuple[float, ...]) -> None:
        raise AssertionError(f"written: {force}")

    def close(self) -> None:
        """Do nothing."""


@pytest.fixture(autouse=True)
def bench(monkeypatch: pytest.MonkeyPatch) -> None:
    """Declare `Bench` beside the installed drivers."""
    from importlib import metadata

    monkeypatch.setitem(sys.modules, __name__, sys.modules[__name__])
    own = EntryPoint("bench", f"{__name__}:Bench", "haptether.masters")

    def found(**selection: Any) -> EntryPoints:  # noqa: ANN401  # as in entry_points
        return EntryPoints([*metadata.entry_points(**selection), *EntryPoints([own]).select(**selection)])

    monkeypatch.setattr("haptether.bridge.devices.find.entry_points", found)


def leader(folder: Path) -> str:
    """Write the scene of docs/dynamixel.md."""
    page = (ROOT / "docs/dynamixel.md").read_text(encoding="utf-8")
    (text,) = [one for one in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if one.startswith("schema = ")]
    (folder / "leader.toml").write_text(text, encoding="utf-8")
    return str(folder / "leader.toml")


def checked(scene: str, changes: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    """Return status and findings of `haptether check`."""
    capsys.readouterr()
    status = main(["check", scene, *(word for change in changes for word in ("--set", change)), "--json", "-"])
    findings = json.loads(capsys.readouterr().out)["findings"]
    return status, {finding["name"]: finding for finding in findings}


@pytest.mark.parametrize(
    ("side", "case"), [("master", case) for case in MASTERS] + [("slave", case) for case in SLAVES]
)
def test_check_says_what_the_live_side_says(
    side: str, case: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, changes, said = (MASTERS if side == "master" else SLAVES)[case]
    scene = leader(tmp_path) if scene == "LEADER" else scene
    address = ["--peer", "127.0.0.1:9"] if side == "master" else ["--listen", "127.0.0.1:0"]
    quiet = ["--insecure", "--patience-s", "0.1", "--telemetry", "none", "--quiet", "--realtime", "off"]
    sets = [word for change in changes for word in ("--set", change)]
    assert main([side, "--scene", scene, *address, *quiet, *sets]) != 0
    live = capsys.readouterr().err.splitlines()[-1].removeprefix("haptether: ")
    assert said in live
    found = {each.name: each for each in check_scene(load_scene(scene, changes), remedies=False).findings}
    assert (found[f"{side} driver"].state, found[f"{side} driver"].text) == ("bad", live)


def test_the_leader_of_the_page_passes_with_the_bound_that_master_announces(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = leader(tmp_path)
    command = ["master", "--scene", scene, "--peer", "127.0.0.1:9", "--insecure", "--patience-s", "0.1"]
    # Only the port is missing.
    assert main([*command, "--telemetry", "none", "--quiet", "--realtime", "off"]) == 1
    said = capsys.readouterr().err
    assert "port: is not there" in said
    status, findings = checked(scene, [], capsys)
    assert (status, findings["master driver"]["state"]) == (0, "good")
    (announced,) = re.findall(r"after a release at most [\d.]+ rad/s, by \w+", said)
    assert findings["ejection"]["text"].startswith(announced)
    assert findings["ejection"]["state"] == "not judged"


def test_a_scene_with_a_driver_and_one_side_is_none_of_two(capsys: pytest.CaptureFixture[str]) -> None:
    status, findings = checked("paper_wall", ["master.driver=bench"], capsys)
    assert status == 1
    assert "has no [slave]" in findings["slave driver"]["text"]
    assert findings["master driver"]["state"] == "good"


def test_the_bounds_of_a_driver_are_those_that_are_judged() -> None:
    scene = load_scene("ur_peg", ["slave.options.max_speed=0.1"])
    assert scene.slave is not None
    found = {finding.name: finding.state for finding in check_scene(scene, remedies=False).findings}
    assert found["slave driver"] == "good"
    assert "master driver" not in found
    models = check_scene(load_scene("remote_push"), remedies=False).findings
    assert not [finding for finding in models if finding.name.endswith("driver")]


@pytest.mark.parametrize(
    ("asked", "expected"), [("3.0", 0.2), ('"unbounded"', 0.2), ("0.1", 0.1)], ids=["faster", "unbounded", "slower"]
)
def test_commands_are_no_faster_than_the_arm(asked: str, expected: float) -> None:
    scene = load_scene(
        THREE, [*OF_UR, "slave.options={host='a', axes=3, max_speed=0.2}", f"coupling.command_speed={asked}"]
    )
    bounded, device, _ = slave_drivers(scene)
    assert device is not None
    assert bounded.coupling is not None
    assert bounded.coupling.command_speed == expected


def test_forces_are_no_larger_than_those_of_the_driver() -> None:
    """A force that the driver cuts would count as energy of the arm."""
    options = [*OF_UR, "slave.options.mode=direct-torque", "slave.options.max_force=20"]
    motions = load_scene("remote_push", options)
    for changes, expected in (((), None), (("slave.takes_force=true",), 20.0)):
        table = slave_drivers(override_scene(motions, changes))[0].slave
        assert table is not None
        assert table.max_force_n == expected
    table = slave_drivers(override_scene(motions, ["slave.takes_force=true", "slave.max_force_n=5"]))[0].slave
    assert table is not None
    assert table.max_force_n == 5.0


@pytest.mark.parametrize("takes_force", [False, True])
def test_a_driver_that_promises_forces_without_the_method_is_refused(takes_force: bool) -> None:
    with pytest.raises(DeviceError, match="takes_force = True, and no write_force"):
        check_force(SimpleNamespace(takes_force=True), takes_force=takes_force)
    check_force(SimpleNamespace(takes_force=True, write_force=print), takes_force=takes_force)
