"""Existing files: each option of each command that writes a file refuses an existing one before anything runs."""

from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import pytest

from haptether.cli.entry import COMMANDS, GROUPS, main

LIVE = {"record": "a.mcap", "flight": "a.flight", "json": "a.json"}
JSON = {"json": "a.json"}
WRITTEN: dict[str, tuple[list[str], dict[str, str]]] = {
    "demo": ([], {"out": "a.png", **JSON}),
    "view": (["remote_push"], {"screenshot": "a.png", "movie": "a.gif", "html": "a.html", **JSON}),
    "master": (["--peer", "127.0.0.1:9", "--insecure"], {"trace": "a.npz", **LIVE}),
    "slave": (["--listen", "127.0.0.1:0", "--insecure"], LIVE),
    "check-link": (["--peer", "127.0.0.1:9", "--insecure"], JSON),
    "explain": (["in.mcap"], JSON),
    "simulate": (
        ["remote_push"],
        {"plot": "a.png", "out": "a.npz", "record": "folder/master.mcap", **JSON},
    ),
    "sweep": (["remote_push", "--samples", "1"], {"out": "a.csv", "plot": "a.png", "latex": "a.tex", **JSON}),
    "check": (["remote_push"], JSON),
    "cite": (["remote_push"], {"bibtex": "a.bib", **JSON}),
    "setup": ([], JSON),
    "evaluate": (
        ["remote_push", "--quick"],
        {"out": "folder/evaluation.html", "plot": "a.png", "latex": "a.tex", **JSON},
    ),
    "thresholds": ([], {"plot": "a.png", **JSON}),
    "tune": (["in.mcap"], {"plot": "a.png", **JSON}),
    "falsify": (["remote_push"], {"out": "a.toml", **JSON}),
    "paper": ([], {"plot": "folder/fig05_mev.png", **JSON}),
    "raven": ([], JSON),
    "info": (["in.mcap"], JSON),
    "plot": (["in.mcap"], {"out": "a.png"}),
    "export": (["in.mcap"], {"parquet": "a.parquet", "csv": "a.csv", "npz": "a.npz", "foxglove": "a.mcap"}),
    "replay": (["in.mcap"], {"plot": "a.png", **JSON}),
    "playback": (["in.mcap"], {"plot": "a.png", "out": "a.npz", **JSON}),
    "list": ([], JSON),
    "try": ([], {"record": "folder/left.mcap"}),
    "check-device": (["ur"], JSON),
    "identify": (["touch", "--yes"], JSON),
    "ur-emulator": ([], JSON),
    "dynamixel-emulator": ([], JSON),
    "inverse3-emulator": ([], JSON),
    "netsim list": ([], JSON),
    "netsim sample": ([], {"csv": "a.csv", "plot": "a.png", **JSON}),
    "netsim proxy": (["--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9"], {"log": "a.csv", **JSON}),
    "netsim set": (["--control", "none", "delay_s=0"], JSON),
    "netsim echo": (["--listen", "127.0.0.1:0"], JSON),
    "netsim record": (["127.0.0.1:9"], {"csv": "a.csv", **JSON}),
    "netsim compare": (["delay 1ms"], JSON),
}
"""Per command: the minimal arguments, and a file for each writing option; some files are in a folder."""
MORE = {
    "keygen": ["keygen", "a.key"],
    "calibrate": ["dynamixel", "calibrate", "/dev/none", "a.toml", "--yes"],
    "evaluate, another file": ["evaluate", "remote_push", "--quick", "--out", "folder"],
    "check-device of a gripper": ["check-device", "robotiq", "--side", "gripper", "--json", "a.json"],
    "a log as Parquet": ["netsim", "proxy", *WRITTEN["netsim proxy"][0], "--log", "a.parquet"],
    "a sweep as Parquet": ["sweep", "remote_push", "--samples", "1", "--out", "a.parquet"],
    "falsify by its own name": ["falsify", "remote_push"],
    "plot by its own name": ["plot", "in.mcap"],
    "the picture of a folder": ["simulate", "remote_push", "--plot", "folder"],
    "a folder of a demo": ["demo", "--out", "folder"],
}
THERE = {
    "keygen": "a.key",
    "calibrate": "a.toml",
    "evaluate, another file": "folder/worst.toml",
    "check-device of a gripper": "a.json",
    "a log as Parquet": "a.parquet",
    "a sweep as Parquet": "a.parquet",
    "falsify by its own name": "remote_push_worst.toml",
    "plot by its own name": "in.png",
    "the picture of a folder": "folder/remote_push.png",
    "a folder of a demo": "folder/wsc.npz",
}
NAMES = {
    "json",
    "plot",
    "out",
    "record",
    "csv",
    "parquet",
    "npz",
    "foxglove",
    "latex",
    "screenshot",
    "movie",
    "html",
    "log",
    "bibtex",
}
"""Names of the options that write a file, over all commands."""
CASES = {
    f"{command} --{option}": (
        [*command.split(), *arguments, f"--{option}", file.partition("/")[0] if "/" in file else file],
        file,
    )
    for command, (arguments, files) in WRITTEN.items()
    for option, file in files.items()
} | {name: (arguments, THERE[name]) for name, arguments in MORE.items()}


def test_no_option_that_writes_is_left_out() -> None:
    commands = {
        name if group == "" else f"{group} {name}": command
        for group, of in {"": COMMANDS, **GROUPS}.items()
        for name, command in of.items()
        if group or name not in GROUPS
    }
    written = {
        (name, field.name)
        for name, command in commands.items()
        for field in fields(command)
        if field.name in NAMES and "Path" in str(get_type_hints(command)[field.name])
    }
    # These options have their own rule: the folder must be empty or absent.
    written -= {("new-driver", "out"), ("new-controller", "out")}
    assert written == {(name, option) for name, (_, of) in WRITTEN.items() for option in of if option in NAMES}


@pytest.mark.parametrize("case", CASES)
def test_a_file_that_is_there_is_refused_before_anything_runs(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, file = CASES[case]
    monkeypatch.chdir(tmp_path)
    Path("in.mcap").write_text("")
    Path(file).parent.mkdir(exist_ok=True)
    Path(file).write_text("before")
    before = sorted(tmp_path.rglob("*"))
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert "--force replaces" in said
    assert said.count("\n") == 1
    assert Path(file).read_text() == "before"
    assert sorted(tmp_path.rglob("*")) == before


def test_what_force_replaces_is_written_and_what_nobody_named_needs_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.json").write_text("before")
    assert main(["list", "--json", "a.json", "--force"]) == 0
    assert Path("a.json").read_text() != "before"
    assert main(["list", "--json", "b.json"]) == 0
    assert main(["list", "--json", "/dev/null"]) == 0
