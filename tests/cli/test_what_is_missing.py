"""A missing argument, file, scene or controller is named in one line, with the available ones."""

from pathlib import Path

import pytest

from haptether.cli import main
from haptether.netsim import PRESETS

OWN = "an entry point of the group haptether.controllers"
CONTROLLERS = ("none", "vfc", "hsc", "wsc", "pc")
SAID: dict[str, tuple[list[str], tuple[str, ...]]] = {
    "evaluate": (["evaluate", "--quick"], ("which scene?", "haptether simulate --list", "all")),
    "tune": (["tune"], ("which recordings?", "--record of master")),
    "evaluate --controller": (
        ["evaluate", "remote_push", "--controller", "none", "speed-brake"],
        ("speed-brake", *CONTROLLERS, OWN),
    ),
    "evaluate --controller of a set": (
        ["evaluate", "remote_push", "--controller", "hsc+my.brake"],
        ("my.brake", *CONTROLLERS, OWN),
    ),
    "falsify --controller": (["falsify", "remote_push", "--controller", "speed-brake"], (*CONTROLLERS[1:], OWN)),
    "simulate": (["simulate", "remote_push", "--set", "safety.controllers=[brake]"], (*CONTROLLERS[1:], OWN)),
    "simulate of a table": (["simulate", "remote_push", "--safety.research.controller", "brake"], (OWN,)),
    "a network": (
        ["evaluate", "remote_push", "--network", "missing.csv"],
        ("--network missing.csv: no such file", *PRESETS, "steady, jitter, loss, jitter+loss"),
    ),
    "a network in a folder": (["evaluate", "remote_push", "--network", "a/b.json"], ("a/b.json: no such file",)),
    "nearly a preset": (["evaluate", "remote_push", "--network", "lte-drivin"], ("did you mean lte-driving?",)),
    "no recording": (["evaluate", "remote_push", "--network", "bad.csv"], ("--network bad.csv: line 1, column 1",)),
    "view": (["view", "no.mcap"], ("no.mcap: no such file: give a recording",)),
    "view of two": (["view", "bad.mcap", "no.mcap"], ("no.mcap: no such file",)),
    "view of arrays": (["view", "no.npz"], ("no.npz: no such file",)),
    "view of a scene": (["view", "no.toml"], ("no.toml: no shipped scene and no such file",)),
    "view of a key": (["view", "remote_push", "--set", "safety.no=1"], ("[safety] has no key no",)),
    "console": (["console", "--scene", "paper_wall"], ("paper_wall: has no [slave]", "remote_push")),
    "console of a key": (["console", "--scene", "remote_push", "--set", "safety.no=1"], ("[safety] has no key no",)),
    "slave": (["slave", "--listen", "127.0.0.1:0", "--insecure", "--scene", "paper_wall"], ("has no [slave]",)),
}


@pytest.mark.parametrize(("arguments", "said"), SAID.values(), ids=SAID)
def test_what_is_missing_is_named_in_one_line_with_what_there_is(
    arguments: list[str],
    said: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DISPLAY", raising=False)
    for name in ("bad.csv", "bad.mcap"):
        (tmp_path / name).write_text("garbage\n")
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert not [part for part in said if part not in err], err
