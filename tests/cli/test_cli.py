"""The command line: what it prints, where errors go, and its exit status."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import msgspec
import pytest

from haptether.bridge import DeviceError, load_scene
from haptether.cli import main
from haptether.cli.entry import COMMANDS
from haptether.cli.live.sides import _opened, with_clutch
from haptether.cli.shared.stop import Stopped

pytestmark = pytest.mark.slow

PROXY = ["netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", "127.0.0.1:9"]
COMMAND = [sys.executable, "-m", "haptether"]
LISTEN = ["--listen", "127.0.0.1:0"]
NOBODY = ["--insecure", "--peer", "127.0.0.1:9"]


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments],
        capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "COLUMNS": "200"},
    )  # fmt: skip


def test_version_and_help(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")

    def shown(*arguments: str) -> str:
        with pytest.raises(SystemExit) as ended:
            main(list(arguments))
        assert ended.value.code == 0
        return capsys.readouterr().out

    assert run("--version").stdout.startswith("haptether 0.")
    assert main(["--help"]) == 0
    overview = capsys.readouterr().out
    assert all(f"\n  {name} " in overview for name in COMMANDS)
    assert main(["help"]) == 0
    assert capsys.readouterr().out == overview
    assert main([]) == 2
    assert capsys.readouterr().err == overview
    assert shown("help", "netsim", "sample") == shown("netsim", "sample", "--help")
    for name in ("demo", "paper", "simulate", "sweep", "master", "slave", "netsim", "keygen", "explain", "check-link",
                 "check-device", "identify", "new-driver", "new-controller", "new-impairment", "setup",
                 "cite"):  # fmt: skip
        assert "Examples" in shown(name, "--help")
    for name in ("list", "sample", "proxy", "set", "echo", "record", "compare"):
        assert "Examples" in shown("netsim", name, "--help")


@pytest.mark.sampled(8)
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["slave", "--insecure", "--listen", "nowhere"], "listen = \"nowhere\": "),
        (["master", "--insecure", "--peer", "127.0.0.1:99999"], "peer = \"127.0.0.1:99999\": "),
        (["slave", "--listen", "127.0.0.1:0"], "--key PATH is missing: `haptether keygen PATH` makes a key"),
        (["master", "--peer", "127.0.0.1:9"], "--insecure goes without, in the clear"),
        (["master", "--peer", "127.0.0.1:9", "--key", "a.key", "--insecure"], "--key, --insecure: give one of the two"),
        (["check-link", "--peer", "127.0.0.1:9", "--key", "/proc/self/status"], "others may use this key"),
        ([*PROXY, "--loss", "2"], "loss = 2: must be"),
        (["demo", "--jitter-s", "0.1"], "jitter_s"),
        (["demo", "--seed", "-1"], "seed = -1: must be between 0 and 2^64 - 1"),
        ([*PROXY, "--duration-s", "inf"], "duration_s = inf"),
        (["paper", "--encoder-quantum", "-1"], "encoder_quantum = -1: must be"),
        (["master", *NOBODY, "--priority", "100"], "priority = 100: must be 1 to 99"),
        (["slave", "--insecure", *LISTEN, "--min-free-bytes", "-1"], "min-free-bytes = -1: must be 0 to"),
        (["check-link", *NOBODY, "--duration-s", "601"], "duration-s = 601: must be between"),
        (["check-link", *NOBODY, "--wall-stiffness", "0"], "wall-stiffness = 0: must be above 0"),
        (["check-link", *NOBODY, "--force-scale", "-1"], "force_scale (lambda_f) = -1: must be"),
        (["slave", "--insecure", *LISTEN, "--wall-stiffness", "nan"], "wall stiffness = NaN: must be"),
    ],
)  # fmt: skip
def test_a_bad_request_is_one_line_and_status_2(arguments: list[str], said: str) -> None:
    ended = run(*arguments)
    assert ended.returncode == 2
    assert ended.stderr.startswith("haptether: ")
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "command", [["master", "--peer", "127.0.0.1:9"], ["check-link", "--peer", "127.0.0.1:9"], ["slave", *LISTEN]]
)
@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("missing.key", "No such file or directory"),
        ("locked/arm.key", "Permission denied"),
        ("file/arm.key", "Not a directory"),
    ],
)
def test_a_key_that_cannot_be_read_is_a_bad_request_and_the_remedy_is_named(
    tmp_path: Path, command: list[str], path: str, why: str
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "locked").mkdir(mode=0)
    if why == "Permission denied" and os.access(tmp_path / "locked", os.X_OK):
        pytest.skip("this user may read everything")
    ended = run(*command, "--key", str(tmp_path / path))
    assert ended.returncode == 2
    assert ended.stderr == (
        f"haptether: --key {tmp_path / path}: cannot be read: {why}: must be a key file, the same at both sides; "
        "`haptether keygen PATH` makes one\n"
    )


def test_an_unknown_flag_is_status_2() -> None:
    assert run("paper", "--no-such-flag").returncode == 2


def test_an_unwritable_target_is_status_1(tmp_path: Path) -> None:
    ended = run("paper", "--json", str(tmp_path / "missing" / "rows.json"))
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr


def test_paper_prints_json_alone_on_standard_output() -> None:
    ended = run("paper", "--json", "-")
    assert ended.returncode == 0
    report = json.loads(ended.stdout)
    assert set(report) == {"operator", "device", "joint_fits", "rows"}
    assert {"source", "quantity", "controller", "window", "paper", "ours", "unit"} <= set(report["rows"][0])
    assert "Table 1" in ended.stderr


def test_paper_draws_its_figures(tmp_path: Path) -> None:
    assert run("paper", "--plot", str(tmp_path)).returncode == 0
    drawn = sorted(tmp_path.glob("*.png"))
    assert len(drawn) == 6
    assert all(picture.stat().st_size > 10_000 for picture in drawn)


@pytest.mark.parametrize("clutch", ["once", "auto"])
def test_a_scene_presses_its_clutch_anew_only_where_the_command_says_so(clutch: str) -> None:
    scene = load_scene("ur_peg")
    assert scene.operator is not None
    # The default of a scene is for simulations.
    assert scene.operator.clutch == "auto"
    live = with_clutch(scene, clutch)
    assert live.operator is not None
    assert live.operator.clutch == clutch


def test_a_scene_without_an_operator_has_nobody_who_presses_anew() -> None:
    scene = load_scene("remote_push")
    alone = msgspec.structs.replace(scene, operator=None)
    assert with_clutch(alone, "once") == alone
    with pytest.raises(ValueError, match=r"--clutch auto: the scene has no \[operator\]"):
        with_clutch(alone, "auto")
    driven = msgspec.structs.replace(alone, master=msgspec.structs.replace(alone.master, driver="mine"))
    assert with_clutch(driven, "auto") == driven, "its loop receives it"


def test_times_of_a_clutch_are_kept() -> None:
    scene = load_scene("ur_peg", ["operator.clutch=[[0.1, 2.0]]"])
    assert with_clutch(scene, "once") == scene
    with pytest.raises(ValueError, match="the scene has times for the clutch"):
        with_clutch(scene, "auto")


def test_a_driver_that_times_out_by_itself_is_reported_with_its_own_words() -> None:
    error = DeviceError("Own: TimeoutError: no answer from the arm")
    error.__cause__ = TimeoutError("no answer from the arm")
    given_up: list[bool] = []
    run = SimpleNamespace(ready=lambda: True, finished=True, error=error, give_up=lambda: given_up.append(True))
    with pytest.raises(DeviceError, match="no answer from the arm"):
        _opened(run, object(), "own", Stopped())  # type: ignore[type-var]  # all that it looks at
    assert given_up == [True]


@pytest.mark.sampled(3)
@pytest.mark.parametrize("columns", ["0", "1", "5", "-5", "wide", ""])
def test_no_width_of_a_terminal_takes_output_away(columns: str) -> None:
    for arguments in (["list"], ["netsim", "list"], ["list", "--help"]):
        ended = subprocess.run(
            [*COMMAND, *arguments],
            capture_output=True, text=True, timeout=60, check=True, env={**os.environ, "COLUMNS": columns},
        )  # fmt: skip
        assert len(ended.stdout) > 300, arguments


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["--version"],
        ["master", "--help"],
        ["netsim", "--help"],
        ["--completion", "bash"],
        ["list"],
        ["list", "--json", "-"],
        ["keygen", "a.key", "--force"],
    ],
)
@pytest.mark.parametrize("buffered", [True, False])
def test_output_that_cannot_be_written_is_one_line_or_none(
    arguments: list[str], buffered: bool, tmp_path: Path
) -> None:
    env = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}

    def ended(stdout: int | IO[bytes], stderr: int = subprocess.PIPE) -> tuple[int, bytes | None]:
        found = subprocess.run(
            [*COMMAND, *arguments], stdout=stdout, stderr=stderr, timeout=60, check=False, env=env, cwd=tmp_path
        )
        # Output beside JSON is on standard error.
        return found.returncode, b"" if "--json" in arguments else found.stderr

    with Path("/dev/full").open("wb") as full:
        status, said = ended(full)
    assert (status, said) == (1, b"" if "--json" in arguments else b"haptether: No space left on device\n")
    closed = subprocess.run(
        ["sh", "-c", 'exec "$@" >&-', "sh", *COMMAND, *arguments],
        stderr=subprocess.PIPE, timeout=60, check=False, env=env, cwd=tmp_path,
    )  # fmt: skip
    assert closed.returncode == 1
    assert closed.stderr.endswith(b"haptether: standard output: is closed, must be open: nothing is written there\n")
    assert b"Traceback" not in closed.stderr
    # The key file is written in any case.
    assert ("keygen" in arguments) == (tmp_path / "a.key").exists()
    reading, writing = os.pipe()
    os.close(reading)
    try:
        assert ended(writing) == (141, b"")
        assert ended(writing, writing)[0] == 141
    finally:
        os.close(writing)


@pytest.mark.parametrize("name", ["list", "netsim echo"])
def test_a_pipe_of_its_own_that_breaks_is_said(
    name: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def run() -> int:
        raise BrokenPipeError(errno.EPIPE, "the service has closed the connection")

    monkeypatch.setattr("haptether.cli.entry.parse", lambda _: SimpleNamespace(run=run))
    assert main(name.split()) == 1
    assert capfd.readouterr().err == "haptether: the service has closed the connection\n"


@pytest.mark.sampled(2)
@pytest.mark.parametrize("arguments", [["nosuch"], ["list", "--nosuch"], ["sweep", "remote_push"]])
@pytest.mark.parametrize("buffered", [True, False])
def test_what_is_wrong_goes_to_a_closed_pipe_without_a_word(arguments: list[str], buffered: bool) -> None:
    env = {**os.environ, "PYTHONUNBUFFERED": "" if buffered else "1"}
    reading, writing = os.pipe()
    os.close(reading)
    try:
        ended = subprocess.run(
            [*COMMAND, *arguments], stdout=subprocess.PIPE, stderr=writing, timeout=60, check=False, env=env
        )
    finally:
        os.close(writing)
    assert (ended.returncode, ended.stdout) == (141, b"")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sweep", "remote_push", "--vary", "safety.window=1", "--vary", "safety.window=2"],
         "--vary safety.window: given twice: give all its values at once, as safety.window=v1,v2"),
        (["sweep", "remote_push", "--seed", "1", "--vary", "safety.window=1", "--seed=2"],
         "--seed, --seed: one setting is given twice: leave one of the two out"),
        (["simulate", "remote_push", "--out", "a", "--set", "run.seed=1", "--out", "b"], "--out, --out: one setting"),
        (["netsim", "sample", "--delay-s", "0.1", "--delay_s", "0.2"],
         "--delay-s, --delay_s: one setting is given twice"),
        (["master", *NOBODY, "--release-at-s", "-5"], "release_at_s = -5: must be at least 0 s"),
        (["slave", "--insecure", "--listen", "127.0.0.1:0", "--push-force-n", "nan"], "push force = NaN"),
        (["slave", "--insecure", "--listen", "127.0.0.1:0", "--push-duration-s", "-3"], "push duration = -3"),
        (["slave", "--insecure", "--listen", "127.0.0.1:0", "--push-force-n", "5"],
         "push_force_n = 5: nothing pushes: give --push-at-s, or leave it out"),
    ],
)  # fmt: skip
def test_option_without_effect_is_refused(arguments: list[str], said: str) -> None:
    ended = run(*arguments)
    assert ended.returncode == 2
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["info", "--", "--json", "--json"], 2, "--json: no such file"),
        (["netsim", "sample", "--packets", "5", "--packets", "6", "--help"], 0, "usage: haptether netsim sample"),
        (["simulate", "remote_push", "--out", "--out"], 2, "--out"),
        (["sweep", "remote_push", "--vary", "safety.window=1", "--vary", "run.seed=1,2", "--samples", "1", "--help"], 0,
         "usage: haptether sweep"),
    ],
)  # fmt: skip
def test_repeated_value_of_another_option_is_not_refused(arguments: list[str], status: int, said: str) -> None:
    ended = run(*arguments)
    assert ended.returncode == status
    assert said in ended.stdout + ended.stderr
    assert "given twice" not in ended.stdout + ended.stderr


def test_a_file_of_a_flight_recorder_that_is_no_text_is_named(tmp_path: Path) -> None:
    path = tmp_path / "master.flight"
    path.write_bytes(b'{"schema": 1, "side": "\xff"}')
    ended = run("explain", str(path))
    assert ended.returncode == 2
    assert f"{path}: is no file of a flight recorder" in ended.stderr
