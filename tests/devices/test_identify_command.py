"""`haptether identify` as a process: its question, its bounds, its end by a signal, and its table."""

import json
import signal
import tomllib
from pathlib import Path

import pytest
from tests.devices.drivers import WRITTEN, declared
from tests.devices.terminal import QUESTION, Terminal, forces, run
from tests.ur.stalls import anew_after_stalls


def free(folder: Path) -> dict[str, str]:
    folder.mkdir(exist_ok=True)
    return declared(folder, free="Free", made="RaisesWhenMade", arm="Arm") | {WRITTEN: str(folder / "written")}


@pytest.mark.live
@pytest.mark.timeout(300)
@anew_after_stalls
def test_a_device_that_moves_in_real_time_is_identified_and_left_without_force(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("free")
    ended = run(free(folder), "identify", "free", "--options", "coulomb=0.1", "--yes", "--json", str(folder / "result"))
    assert ended.returncode == 0, ended.stdout + ended.stderr
    result = json.loads((folder / "result").read_text())
    (axis,) = result["results"]
    # The system's timer delays each force differently; the time of each write is known.
    assert axis["mass_kg"]["value"] == pytest.approx(0.1, rel=0.03)
    assert axis["coulomb"]["value"] == pytest.approx(0.1, rel=0.05)
    assert axis["viscous"]["value"] == pytest.approx(0.5, rel=0.1)
    table = tomllib.loads(result["table"])["master"]
    assert table["driver"] == "free"
    assert table["options"] == {"coulomb": 0.1}
    assert table["encoder_quantum"] == pytest.approx(2.3e-5)
    assert result["table"] in ended.stdout
    assert "Nobody may hold or touch it" in ended.stderr
    told = forces(folder / "written")
    assert max(map(abs, told)) <= 1.0
    assert told[0] == told[-1] == 0.0
    assert (folder / "written").read_text().split()[-1] == "close"


@pytest.mark.live
@pytest.mark.parametrize("answer", ["no\n", "\n"])
def test_nothing_moves_without_a_yes(tmp_path: Path, answer: str) -> None:
    terminal = Terminal(free(tmp_path), "identify", "free")
    terminal.answer("yes\n")
    terminal.until(QUESTION)
    terminal.answer(answer)
    assert terminal.end() == 1
    assert "nobody said yes: nothing was moved" in terminal.printed
    assert set(forces(tmp_path / "written")) == {0.0}


@pytest.mark.live
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@anew_after_stalls
def test_a_signal_ends_the_motion_at_zero(tmp_path_factory: pytest.TempPathFactory, number: signal.Signals) -> None:
    folder = tmp_path_factory.mktemp("free")
    written = folder / "written"
    terminal = Terminal(free(folder), "identify", "free")
    terminal.until(QUESTION)
    assert set(forces(written)) == {0.0}
    terminal.answer("yes\n")
    while max(map(abs, forces(written)[-50:])) < 0.05:
        terminal.read(0.01)
    terminal.process.send_signal(number)
    assert terminal.end() == 130, terminal.printed
    assert forces(written)[-1] == 0.0
    assert written.read_text().split()[-1] == "close"


@pytest.mark.live
def test_a_driver_that_hangs_while_it_moves_is_said_to_keep_its_command(tmp_path: Path) -> None:
    ended = run(free(tmp_path), "identify", "free", "--yes", "--options", "hangs_at=50", "--open-s", "5")
    assert ended.returncode == 1
    assert "its device keeps its last command, switch it off" in ended.stderr or "a sample came" in ended.stderr


@pytest.mark.sampled(3)
@pytest.mark.live
@pytest.mark.parametrize(
    ("arguments", "said", "status"),
    [
        (["free"], "identify moves the device: a person must say yes on the terminal", 2),
        (["free", "--yes", "--max-force", "6"], "max-force = 6: must be above 0 and at most 5", 2),
        (["free", "--yes", "--travel", "0"], "travel = 0: must be above 0 and at most 0.1", 2),
        (["free", "--yes", "--max-speed", "nan"], "max-speed = nan: must be above 0", 2),
        (["free", "--yes", "--axes", "1"], "axes = 1: must be of 0 to 0, each once", 2),
        (["free", "--yes", "--kind", "joints"], "kind = joints: free is a driver of linear", 2),
        (["frei", "--yes"], "did you mean free?", 2),
        (["made", "--yes"], "RaisesWhenMade: KeyError: 'counts per turn'", 1),
    ],
)
def test_what_cannot_be_is_one_line_and_no_force(tmp_path: Path, arguments: list[str], said: str, status: int) -> None:
    ended = run(free(tmp_path), "identify", *arguments)
    assert ended.returncode == status, ended.stderr
    assert said in ended.stderr
    assert ended.stderr.count("haptether: ") == 1
    written = tmp_path / "written"
    assert not written.exists() or not any(forces(written))


@pytest.mark.live
@pytest.mark.parametrize(
    "command",
    [
        ["check-device", "made"],
        ["identify", "made", "--yes"],
        ["master", "--peer", "127.0.0.1:9", "--insecure", "--scene", "remote_push", "--set", "master.driver=made"],
    ],
)
def test_a_driver_that_cannot_be_made_is_named_and_with_debug_its_line(tmp_path: Path, command: list[str]) -> None:
    for debug in (False, True):
        (tmp_path / str(debug)).mkdir()
        ended = run(free(tmp_path / str(debug)), *command, *(["--debug"] if debug else []))
        assert ended.returncode == 1
        assert "RaisesWhenMade: KeyError: 'counts per turn'" in ended.stderr
        assert ("drivers.py" in ended.stderr) == debug
        assert ("Traceback" in ended.stderr) == debug
        assert ('raise KeyError("counts per turn")' in ended.stderr) == debug
