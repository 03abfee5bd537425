"""Output encodings that lack characters, and unusual settings of a user's environment."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from haptether.cli.entry import complain
from haptether.cli.live import run_folder
from haptether.view.picture.gl import NoGlError, display_problem, require_gl

COMMANDS = (["--help"], ["netsim", "--help"], ["sweep", "--help"], ["list"])


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_help_is_whole_in_any_encoding(arguments: list[str], encoding: str) -> None:
    texts = []
    for each in ("utf-8", encoding):
        environment = {**os.environ, "PYTHONIOENCODING": each, "PYTHONUTF8": "0", "COLUMNS": "100"}
        command = [sys.executable, "-m", "haptether", *arguments]
        seen = subprocess.run(command, env=environment, capture_output=True, timeout=60, check=False)
        assert seen.returncode == 0, seen.stderr
        texts.append("".join(character for character in seen.stdout.decode(each) if character.isalnum()))
    # Tables wrap differently, and characters missing in the encoding are left out.
    assert len(texts[1]) > 0.95 * len(texts[0]) > 100


@pytest.mark.skipif(sys.platform != "linux", reason="X11")
@pytest.mark.parametrize("display", [":97", "127.0.0.1:97", "nonsense"])
def test_a_display_that_does_not_answer_is_said_before_a_window_is_opened(
    display: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", display)
    assert "libX11" in display_problem() or f"DISPLAY = {display}: no X server answers" in display_problem()
    with pytest.raises(NoGlError, match=r"no display .*give --screenshot, --movie or --html"):
        require_gl(window=True)


@pytest.mark.parametrize("variable", ["XDG_RUNTIME_DIR", "TMPDIR"])
def test_a_folder_that_is_too_long_for_a_socket_leaves_another(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / ("x" * 100)
    deep.mkdir(mode=0o700)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(deep if variable == "TMPDIR" else tmp_path))
    if variable == "XDG_RUNTIME_DIR":
        monkeypatch.setenv(variable, str(deep))
    path = run_folder.default_telemetry("master")
    assert path is not None
    assert len(os.fsencode(path)) <= run_folder.MAX_PATH
    assert deep not in path.parents


@pytest.mark.parametrize("error", [OSError(9, "Bad file descriptor"), OSError("Bad file descriptor (os error 9)")])
def test_closed_descriptors_are_said_to_be_somebody_elses_doing(
    error: OSError, capsys: pytest.CaptureFixture[str]
) -> None:
    complain(error, 1)
    assert "a driver or a library, has closed its files and sockets" in capsys.readouterr().err
