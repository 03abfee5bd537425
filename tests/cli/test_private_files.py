"""Files of commands are private to their user and go to the given path only."""

import os
import stat
import subprocess
import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from tests.faults.running import HAPTETHER

from haptether.bridge import simulate, sweep
from haptether.cli import main
from haptether.cli.netsim.proxy import Log
from haptether.cli.shared.output import write_json
from haptether.private_file import begin_private, private_file, write_private

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from collections.abc import Callable

SAMPLE = ("netsim", "sample", "--packets", "100")
SHORT = ("--run.duration_s", "0.1")
PROXY = ("netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9", "--duration-s", "0.3",
         "--no-realtime")  # fmt: skip
SLAVE = ("slave", "--insecure", "--listen", "127.0.0.1:0", "--patience-s", "0.3", "--realtime", "off")
MASTER = ("master", "--insecure", "--peer", "127.0.0.1:9", "--patience-s", "0.3", "--realtime", "off")
EMULATOR = ("ur-emulator", "--host", "127.77.3.12", "--duration-s", "0.3")
WRITERS: dict[str, tuple[str, ...]] = {
    "list.json": ("list", "--json"),
    "simulate.json": ("simulate", "remote_push", *SHORT, "--json"),
    "simulate.npz": ("simulate", "remote_push", *SHORT, "--out"),
    "sweep.csv": ("sweep", "remote_push", *SHORT, "--vary", "run.seed=1,2", "--out"),
    "sweep.npz": ("sweep", "remote_push", *SHORT, "--vary", "run.seed=1,2", "--out"),
    "sweep.json": ("sweep", "remote_push", *SHORT, "--vary", "run.seed=1,2", "--json"),
    "sample.json": (*SAMPLE, "--json"),
    "sample.csv": (*SAMPLE, "--csv"),
    "sample.png": (*SAMPLE, "--plot"),
    "presets.json": ("netsim", "list", "--json"),
    "proxy.json": (*PROXY, "--json"),
    "proxy.csv": (*PROXY, "--log"),
    "proxy.parquet": (*PROXY, "--log"),
    "slave.json": (*SLAVE, "--json"),
    "slave.mcap": (*SLAVE, "--min-free-bytes", "0", "--record"),
    "slave.flight": (*SLAVE, "--flight"),
    "master.json": (*MASTER, "--json"),
    "master.npz": (*MASTER, "--trace"),
    "master.mcap": (*MASTER, "--min-free-bytes", "0", "--record"),
    "emulator.json": (*EMULATOR, "--json"),
}
"""The file is the value of the last option."""


@pytest.mark.parametrize("name", WRITERS)
def test_force_replaces_a_file_that_is_there_and_no_link(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, victim = tmp_path / name, tmp_path / "victim"
    path.write_text("before")
    path.chmod(0o644)
    main([*WRITERS[name], str(path), "--force"])
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.read_bytes() != b"before" or name == "slave.flight"
    path.unlink()
    victim.write_text("before")
    capsys.readouterr()
    for to in (victim, tmp_path / "nowhere"):
        path.symlink_to(to)
        assert main([*WRITERS[name], str(path), "--force"]) == 1
        assert "is a symbolic link, must be a file" in capsys.readouterr().err
        assert path.is_symlink()
        path.unlink()
    assert victim.read_text() == "before"
    assert [each.name for each in tmp_path.iterdir()] == ["victim"]


@pytest.mark.parametrize("name", ["run.npz", "sweep.csv", "sweep.npz"])
def test_results_are_saved_for_their_owner_alone(name: str, tmp_path: Path) -> None:
    path, victim = tmp_path / name, tmp_path / "victim"
    brief = ["run.duration_s=0.1"]
    save: Callable[[Path], None]
    if name == "run.npz":
        save = simulate("remote_push", overrides=brief).save
    else:
        save = sweep("remote_push", {"run.seed": [1, 2]}, overrides=brief).save
    path.write_text("before")
    path.chmod(0o666)
    save(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    content = path.read_bytes()
    victim.write_bytes(content)
    path.unlink()
    path.symlink_to(victim)
    with pytest.raises(OSError, match="symbolic link"):
        save(path)
    if name.endswith(".npz"):
        assert all(array.size for array in np.load(victim).values())
    else:
        assert content.count(b"\n") == 3


@pytest.mark.parametrize("arguments", [(*SAMPLE, "--csv"), ("list", "--json")], ids=lambda of: of[0])
def test_streams_and_pipes_are_written_to(arguments: tuple[str, ...], tmp_path: Path) -> None:
    piped = subprocess.run([*HAPTETHER, *arguments, "/dev/stdout"], capture_output=True, check=True, timeout=60)
    assert len(piped.stdout) > 200
    with (tmp_path / "out").open("wb") as out:
        subprocess.run([*HAPTETHER, *arguments, "/dev/stdout"], stdout=out, check=True, timeout=60)
    assert len((tmp_path / "out").read_bytes()) >= len(piped.stdout) - 200
    assert main([*arguments, "/dev/null"]) == 0
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)
    os.mkfifo(tmp_path / "pipe")
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append((tmp_path / "pipe").read_bytes()))
    reader.start()
    assert main([*arguments, str(tmp_path / "pipe")]) == 0
    reader.join(30.0)
    assert len(read[0]) > 200


def test_what_is_not_written_to_its_end_leaves_the_file_that_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a"
    write_private(path, b"before")
    with pytest.raises(KeyboardInterrupt), private_file(path) as file:  # noqa: PT012  # interrupted in the middle
        file.write(b"half")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(FileNotFoundError, match=r"nowhere/a'"):
        write_private(tmp_path / "nowhere" / "a", b"")
    # The longest permitted name.
    long = tmp_path / ("a" * 255)
    before = os.umask(0o777)
    try:
        write_private(long, b"all")
    finally:
        os.umask(before)
    assert stat.S_IMODE(long.stat().st_mode) == 0o600


def test_a_link_that_is_planted_while_a_command_runs_is_replaced(tmp_path: Path) -> None:
    path, victim = tmp_path / "a.json", tmp_path / "victim"
    victim.write_text("before")
    path.symlink_to(victim)
    write_json(path, b"{}")
    assert (path.read_text(), path.is_symlink(), victim.read_text()) == ("{}\n", False, "before")


def test_what_opens_a_file_by_its_name_finds_a_private_one(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("before")
    path.chmod(0o644)
    begin_private(path)
    assert (path.read_text(), stat.S_IMODE(path.stat().st_mode)) == ("", 0o600)
    (tmp_path / "link.csv").symlink_to(path)
    with pytest.raises(OSError, match="symbolic link"):
        begin_private(tmp_path / "link.csv")
    with pytest.raises(OSError, match="symbolic link"):
        Log.checked(tmp_path / "link.csv", force=True)
    os.mkfifo(tmp_path / "pipe")
    # An ordinary open would wait for a reader.
    begin_private(tmp_path / "pipe")
