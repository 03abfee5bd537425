"""The tutorials run as printed, show the output of their commands, and quote its numbers.

Each `sh` block of a page runs, in its order, in one shell and one folder. A `text` block shows lines of the output of
the commands above it, in their order. `<!-- by a person -->` marks commands that need a person. The numbers of
output are to 1 %, or as `<!-- numbers within 10 % -->` allows for what depends on the time of this machine.
"""

import contextlib
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.ur.stalls import anew_after_stalls

pytestmark = [pytest.mark.live, pytest.mark.alone]

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(page for page in (ROOT / "docs" / "tutorials").glob("*.md") if page.name != "README.md")
BLOCK = re.compile(
    r"^(?:<!-- (by a person|numbers within \d+ %) -->\n)?```(sh|text)\n(.*?)^```$", re.MULTILINE | re.DOTALL
)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)")
QUOTED = re.compile(r"(\d+(?:\.(\d+))?) (?:m/s|ms|mm|m|N|N/m|Hz|%)(?!\w)")
PERSON = {
    "haptether try",
    "cell/start-emulators.sh",
    "cell/start-slave.sh",
    "cell/start-master.sh",
    "haptether netsim echo --listen 0.0.0.0:9200",
    "haptether netsim record 192.0.2.7:9200 --rate 500 --duration-s 60 --csv measured.csv",
}
"""Commands that need a person, a browser or a second machine."""
TOLERANCE = 0.01
PAGE_S = 240.0
END_S = 10.0


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Return mark, kind and text of each block of a page."""
    return BLOCK.findall(page.read_text())


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return an activated environment with all packages of this one, in which a page may install a package."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    (packages,) = folder.glob("lib/python*/site-packages")
    ours = next(path for path in sys.path if path.endswith("site-packages"))
    (packages / "ours.pth").write_text(f"import site; site.addsitedir({ours!r})\n")
    command = folder / "bin" / "haptether"
    command.write_text(f'#!/bin/sh\nexec {folder}/bin/python -m haptether "$@"\n')
    command.chmod(0o700)
    # The packages that it has are not its own, and uv sees its own only.
    (folder / "uv.toml").write_text("[pip]\nno-deps = true\n")
    uv = Path(os.environ.get("UV", ROOT / ".tools" / "uv" / "bin" / "uv")).parent
    return {
        "PATH": f"{folder}/bin:{uv}:{os.defpath}",
        "VIRTUAL_ENV": str(folder),
        "HOME": str(folder),
        "COLUMNS": "100",
        "UV_OFFLINE": "1",
        "UV_CACHE_DIR": str(folder / "cache"),
        "UV_CONFIG_FILE": str(folder / "uv.toml"),
        "MPLCONFIGDIR": str(folder / "matplotlib"),
    }


def run(page: Path, folder: Path, environment: dict[str, str]) -> Iterator[tuple[str, str, str]]:
    """Run a page, and yield each `text` block with its mark and the output of the commands above it."""
    script, shown, last = ["set -e"], [], 0
    for at, (mark, kind, text) in enumerate(blocks(page)):
        if kind == "text":
            shown.append((mark, text, last))
        elif mark != "by a person":
            script.append(f"{{\n{text}}} >.output-{at} 2>&1")
            last = at
    started = subprocess.Popen(
        ["bash", "-c", "\n".join(script)],
        cwd=folder, env=environment, stdin=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    try:
        status = started.wait(timeout=PAGE_S)
        outputs = {int(path.name.partition("-")[2]): path.read_text() for path in folder.glob(".output-*")}
        assert status == 0, outputs[max(outputs)]
        end_s = time.monotonic() + END_S
        while of_session(started.pid):
            assert time.monotonic() < end_s, "the page does not end what it starts"
            time.sleep(0.05)
    finally:
        for process in of_session(started.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        started.wait()
    for mark, text, block in shown:
        yield mark, text, outputs[block]


def of_session(session: int) -> list[int]:
    """Return the processes of a session that run."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            # After the name in brackets: state, parent, group, session.
            state, _, _, of = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(of) == session and state != "Z":
                found.append(int(folder.name))
    return found


def missing_lines(text: str, output: str, tolerance: float) -> Iterator[str]:
    """Yield the shown lines that the output does not have in this order, with these numbers."""
    # Lines are wrapped at the width of the terminal.
    output, at = " ".join(output.split()), 0
    for line in text.splitlines():
        if line.strip() in {"", "..."}:
            continue
        plain = " ".join(line.split())
        values = [float(number) for number in NUMBER.findall(plain)]
        pattern = NUMBER.pattern.join(re.escape(part) for part in NUMBER.split(plain))
        for found in re.compile(pattern).finditer(output, at):
            seen = [float(number) for number in NUMBER.findall(found[0])]
            if all(math.isclose(a, b, rel_tol=tolerance) for a, b in zip(values, seen, strict=True)):
                at = found.end()
                break
        else:
            yield line


def unseen_quotes(page: str) -> Iterator[str]:
    """Yield the numbers with a unit in the sentences of a page that no block has, as it is, in ms or mm, or in %."""
    seen = [abs(float(number)) for _, _, text in BLOCK.findall(page) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]
    for quoted in QUOTED.finditer(re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)):
        places = len(quoted[2] or "")
        if not any(round(number * scale, places) == float(quoted[1]) for number in seen for scale in (1, 100, 1000)):
            yield quoted[0]


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
@anew_after_stalls
def test_a_page_runs_and_shows_what_its_commands_print(page: Path, tmp_path: Path, environment: dict[str, str]) -> None:
    shown = list(run(page, Path(tempfile.mkdtemp(dir=tmp_path)), environment))
    assert shown
    for mark, text, output in shown:
        tolerance = int(mark.split()[2]) / 100.0 if mark else TOLERANCE
        missing = list(missing_lines(text, output, tolerance))
        assert not missing, output


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_numbers_in_sentences_are_those_of_commands_or_output(page: Path) -> None:
    assert not list(unseen_quotes(page.read_text()))


def test_only_commands_for_a_person_are_left_out() -> None:
    assert len(PAGES) == 4
    left_out = {
        line.partition("#")[0].strip()
        for page in PAGES
        for mark, kind, text in blocks(page)
        if mark == "by a person"
        for line in text.splitlines()
    }
    assert left_out == PERSON


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("largest force [N] 3.37\n...\nrows: 20", []),
        ("largest force [N] 3.45", ["largest force [N] 3.45"]),
        ("largest force [N] 3.30", ["largest force [N] 3.30"]),
        ("rows: 20\nlargest force [N] 3.37", ["largest force [N] 3.37"]),
        ("largest torque [N] 3.37", ["largest torque [N] 3.37"]),
    ],
)
def test_a_wrong_line_is_found(text: str, missing: list[str]) -> None:
    assert list(missing_lines(text, "a 1\nlargest   force [N]  3.373\n rows:\n20", TOLERANCE)) == missing


def test_a_wrong_number_in_a_sentence_is_found() -> None:
    page = "It flies at 2.2 m/s after 57 ms, or 58 ms, with 1 % loss.\n\n```text\nv 2.19\nt 0.057\nloss 0.01\n```\n"
    assert list(unseen_quotes(page)) == ["58 ms"]
