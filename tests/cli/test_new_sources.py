"""`haptether new-controller --rust` and `new-impairment`: a formatted file, its lines, and a test that passes."""

import ast
import contextlib
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from haptether.cli import main

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("rustfmt.toml", "safety/__init__.py", "safety/src/controller", "netsim/src/impairments",
          "netsim/link/settings.py", "python/haptether/cli/live/options.py")  # fmt: skip
RUSTFMT = ["rustfmt", "--check", "--edition", "2024"]
NAMES = '"vfc", "hsc", "wsc", "pc", "speed-brake"'
CASES = {
    "controller": (
        ["new-controller", "speed-brake", "--rust"],
        "safety/src/controller/speed_brake.rs",
        {
            "safety/src/controller/mod.rs": ["mod speed_brake;", "    SpeedBrake: speed_brake::SpeedBrakeController;"],
            "safety/__init__.py": [f"ControllerName: TypeAlias = Literal[{NAMES}]"],
            "python/haptether/cli/live/options.py": [f'Controller = Literal["none", {NAMES}]'],
        },
    ),
    "impairment": (
        ["new-impairment", "micro-fade"],
        "netsim/src/impairments/micro_fade.rs",
        {
            "netsim/src/impairments/mod.rs": [
                "mod micro_fade;", "    micro_fade::build,", "    pub micro_fade: f64,", "            micro_fade: 0.0,",
                "    MicroFade = 14,", "            || self.micro_fade > 0.0",
            ],
            "netsim/link/settings.py": ["    micro_fade: Share | None = None", '    "micro_fade": 0.0,'],
        },
    ),
}  # fmt: skip


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Copy of the files that the commands change."""
    for name in COPIED:
        target = tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, target)
    return tmp_path


def contents(folder: Path) -> dict[Path, str]:
    return {path: path.read_text() for path in folder.rglob("*") if path.suffix in {".rs", ".py"}}


@pytest.mark.parametrize(("arguments", "made", "changed"), CASES.values(), ids=CASES)
def test_file_and_lines_are_in_place_and_formatted_and_nothing_is_overwritten(
    checkout: Path,
    arguments: list[str],
    made: str,
    changed: dict[str, list[str]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = contents(checkout)
    # The checkout is that around the working folder.
    with contextlib.chdir((checkout / made).parent):
        assert main(arguments) == 0
    said = capsys.readouterr().out
    after = contents(checkout)
    assert {path for path in after if after[path] != before.get(path)} == {checkout / name for name in (made, *changed)}
    assert all(str(checkout / name) in said for name in (made, *changed))
    assert "next: cargo test" in said
    for name, lines in changed.items():
        text = after[checkout / name]
        assert set(lines) <= set(text.splitlines())
        assert len(text.splitlines()) >= len(before[checkout / name].splitlines())
    assert not re.search(r"@[A-Z]+@", after[checkout / made])
    for name in (made, *changed):
        if name.endswith(".py"):
            ast.parse(after[checkout / name])
        else:
            ended = subprocess.run(RUSTFMT, input=after[checkout / name], cwd=(checkout / name).parent,
                                   capture_output=True, text=True, check=False)  # fmt: skip
            assert (ended.returncode, ended.stdout) == (0, "")
    with contextlib.chdir(checkout):
        assert main(arguments) == 2
    assert "is there already" in capsys.readouterr().err
    assert contents(checkout) == after


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["new-controller", "Speed", "--rust"], "must be small letters and digits with dashes between"),
        (["new-controller", "wsc", "--rust"], "controller of this name exists already"),
        (["new-controller", "wsc"], "controller of this name exists already"),
        (["new-controller", "match", "--rust"], "a keyword of Rust"),
        (["new-controller", "probe", "--rust"], "probe.rs: is there already"),
        (["new-controller", "brake", "--rust", "--out", "x"], "--out: a controller in Rust has its place"),
        (["new-controller", "brake", "--checkout", "x"], "--checkout: a package in Python needs no checkout"),
        (["new-controller", "brake", "--rust", "--checkout", "x"], "x: no source checkout of Haptether"),
        (["new-impairment", "delay-s"], "impairment of this name exists already"),
        (["new-impairment", "slots"], "impairment of this name exists already"),
        (["new-impairment", "law"], "law.rs: is there already"),
        (["new-impairment", "fade", "--checkout", "x"], "clone the repository and run there"),
    ],
)
def test_a_bad_request_is_one_line_and_changes_nothing(
    checkout: Path, arguments: list[str], said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(checkout)
    monkeypatch.chdir(checkout)
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
    assert contents(checkout) == before


def test_a_file_without_a_place_for_the_line_is_named_and_nothing_is_written(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (checkout / "netsim/link/settings.py").write_text("")
    before = contents(checkout)
    monkeypatch.chdir(checkout)
    assert main(["new-impairment", "fade"]) == 2
    assert "settings.py: has no place for the line: add it by hand: fade: Share" in capsys.readouterr().err
    assert contents(checkout) == before


REGISTERED = """//! The controller that was added.
use haptether_safety::controller::{ControllerKind, Tripped};

#[test]
fn it_has_a_name_a_bit_and_a_column() {
    let kind = ControllerKind::SpeedBrake;
    assert_eq!((kind.about().name, kind.observed().column), ("speed-brake", "speed_brake"));
    assert_eq!(Tripped::of(kind).bits(), 32);
    let names = ["vfc", "hsc", "wsc", "pc", "speed-brake", "held"];
    assert_eq!(Tripped::from_bits(63).names().collect::<Vec<_>>(), names);
}
"""


@pytest.mark.thorough
@pytest.mark.alone
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("arguments", "room", "module", "passed"),
    [
        (["new-controller", "speed-brake", "--rust"], "safety", "controller::speed_brake", ["1", "1"]),
        (["new-impairment", "micro-fade"], "netsim", "impairments::micro_fade", ["2"]),
    ],
)
def test_what_it_writes_compiles_and_its_test_passes(
    tmp_path: Path, arguments: list[str], room: str, module: str, passed: list[str]
) -> None:
    rooms = sorted({"numeric", "safety", "netsim"})
    for name in ("Cargo.toml", "Cargo.lock", "rustfmt.toml", "clippy.toml"):
        shutil.copy(ROOT / name, tmp_path)
    for each in (*rooms, "python/haptether/cli/live"):
        shutil.copytree(ROOT / each, tmp_path / each, ignore=shutil.ignore_patterns("__pycache__"))
    manifest = (tmp_path / "Cargo.toml").read_text()
    members = ", ".join(f'"{each}"' for each in rooms)
    changed = re.sub(r"(?m)^(default-)?members = \[.*\]$", rf"\1members = [{members}]", manifest)
    assert changed != manifest
    (tmp_path / "Cargo.toml").write_text(changed)
    assert main([*arguments, "--checkout", str(tmp_path)]) == 0
    (tmp_path / "safety" / "tests" / "added.rs").write_text(REGISTERED)
    environment = os.environ | {
        "CARGO_TARGET_DIR": str(ROOT / "target" / "added-sources"),
        "CARGO_PROFILE_TEST_OPT_LEVEL": "0",
        "CARGO_PROFILE_TEST_DEBUG": "0",
        "RUSTFLAGS": "-D warnings",
    }
    test = ["--test", "added"] if room == "safety" else []
    command = [
        "cargo",
        "test",
        "--offline",
        "--quiet",
        "-p",
        f"haptether-{room}",
        "--lib",
        *test,
        "--",
        f"{module}::",
        "it_has",
    ]
    done = subprocess.run(
        command, check=False, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=580
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.findall(r"(\d) passed", done.stdout) == passed
