"""`haptether new-driver` and `new-controller`: the package is sound, installs and passes its test; so does the page."""

import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.cli.new import controller, driver
from haptether.cli.new.package import checked_package

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
COMMAND = [sys.executable, "-m", "haptether"]
UV = os.environ.get("UV", str(ROOT / ".tools" / "uv" / "bin" / "uv"))
BIN = Path(sys.executable).parent


def run(
    *arguments: str, cwd: Path, environment: dict[str, str] | None = None, status: int = 0
) -> subprocess.CompletedProcess[str]:
    ended = subprocess.run(
        [*arguments], cwd=cwd, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=110,
        check=False,
    )  # fmt: skip
    assert ended.returncode == status, ended.stdout + ended.stderr
    return ended


def environment_of(folder: Path) -> dict[str, str]:
    """Return an environment with the packages in `folder/site`; of the repository it has Haptether only."""
    return {
        "PYTHONPATH": str(folder / "site"), "PATH": "/usr/bin:/bin", "COLUMNS": "200", "HOME": str(folder),
        "UV_CACHE_DIR": str(folder / "cache"), "UV_PYTHON_DOWNLOADS": "never",
    }  # fmt: skip


def install(package: Path, folder: Path) -> None:
    """Install as `pip install` does, without a network."""
    place = ["--python", sys.executable, "--target", str(folder / "site")]
    run(UV, "pip", "install", "--quiet", "--offline", "--no-deps", *place, str(package), cwd=folder,
        environment=environment_of(folder))  # fmt: skip


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("command", "name", "files"),
    [
        (["new-driver", "slave"], "arm7", driver.FILES),
        (["new-driver", "master"], "my-stylus", driver.FILES),
        (["new-controller"], "speed-brake", controller.FILES),
    ],
)
def test_what_it_writes_is_sound_and_its_own_test_passes_once_it_is_installed(
    tmp_path: Path, command: list[str], name: str, files: dict[str, str]
) -> None:
    said = run(*COMMAND, *command, name, "--out", str(tmp_path / "made"), cwd=tmp_path).stdout
    made = tmp_path / "made"
    # The advised command must work in this environment.
    advised = shlex.split(said.partition("next: ")[2].partition(" && ")[0])
    assert advised[-2:] == ["-e", str(made)]
    run(*advised, "--dry-run", "--no-deps", *(["--offline"] if advised[1] == "pip" else []), cwd=tmp_path,
        environment=environment_of(tmp_path))  # fmt: skip
    package = name.replace("-", "_")
    written = sorted(str(path.relative_to(made)) for path in made.rglob("*") if path.is_file())
    assert written == sorted(target.replace("@PACKAGE@", package) for target in files.values())
    assert not [path for path in made.rglob("*") if path.is_file() and re.search(r"@[A-Z]+@", path.read_text())]
    run(
        str(BIN / "ruff"), "check", "--isolated", "--line-length", "120", "--select", "E,F,I,ANN,D1,B,UP", ".", cwd=made
    )
    run(str(BIN / "ruff"), "format", "--isolated", "--line-length", "120", "--check", ".", cwd=made)
    typed = {**os.environ, "MYPYPATH": str(made / "src")}
    cache = ROOT / ".mypy_cache" / "new" / name
    run(sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(cache), "src", "tests", cwd=made,
        environment=typed)  # fmt: skip
    install(made, tmp_path)
    environment = environment_of(tmp_path)
    ended = run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests", cwd=made,
                environment=environment)  # fmt: skip
    assert "2 passed" in ended.stdout
    listed = run(*COMMAND, "list", "--json", "-", cwd=tmp_path, environment=environment).stdout
    assert f'"{name}"' in listed


def commands(text: str) -> list[str]:
    """Return the commands of the page, line by line."""
    return [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines() if line]


@pytest.mark.timeout(300)
def test_the_page_is_true_command_by_command(tmp_path: Path) -> None:
    """The package of the page is installed without a network, checked, and leads a simulated arm."""
    environment = environment_of(tmp_path)
    slave, address = None, ""
    typed = commands((ROOT / "docs" / "new_device.md").read_text())
    assert [line.split()[1] for line in typed if line.startswith("haptether")] == [
        "new-driver", "list", "check-device", "slave", "master",
    ]  # fmt: skip
    try:
        for line in typed:
            words = shlex.split(line.removesuffix(" &"))
            if words[:2] == ["pip", "install"]:
                install(tmp_path / words[2], tmp_path)
            elif words[0] == "python":
                run(sys.executable, *words[1:], "-p", "no:cacheprovider", cwd=tmp_path, environment=environment)
            elif words[:2] == ["haptether", "slave"]:
                # Another test may use that port.
                words[words.index("--listen") + 1] = "127.0.0.1:0"
                slave = subprocess.Popen(
                    [*COMMAND, *words[1:]], cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                )  # fmt: skip
                assert slave.stderr is not None
                while "listens on" not in (said := slave.stderr.readline()):
                    assert said, "it ended"
                address = said.split("listens on ")[1].split()[0].rstrip(",")
            else:
                if words[1] == "master":
                    words[words.index("--peer") + 1] = address
                    words += ["--json", "run.json"]
                ended = run(*COMMAND, *words[1:], cwd=tmp_path, environment=environment)
                if words[1] == "list":
                    assert "my-stylus" in ended.stdout
                if words[1] == "check-device":
                    assert ended.stdout.rstrip().endswith("pass")
    finally:
        if slave is not None:
            slave.send_signal(signal.SIGINT)
            try:
                slave.communicate(timeout=30)
            finally:
                slave.kill()
                slave.wait()
    import json

    result = json.loads((tmp_path / "run.json").read_text())
    assert result["engaged_s"] is not None
    assert result["link"]["rate_hz"] > 500.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["master", "My-Stylus"], "must be small letters and digits with dashes between"),
        (["master", "../stylus"], "must be small letters"),
        (["master", "json"], "a package of this name is another one"),
        (["master", "class"], "a package of this name is another one"),
        (["slave", "ur"], "driver of this name exists already"),
        (["slave", "simulated"], "driver of this name exists already"),
        (["master", "stylus", "--out", "full"], "full: is there already"),
        (["master", "stylus", "--out", "file"], "file: is there already"),
    ],
)
def test_a_bad_request_is_one_line_and_status_2_and_writes_nothing(
    tmp_path: Path, arguments: list[str], said: str
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.py").write_text("")
    (tmp_path / "file").write_text("")
    before = sorted(tmp_path.rglob("*"))
    ended = run(*COMMAND, "new-driver", *arguments, cwd=tmp_path, status=2)
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


@given(st.text(alphabet="ab9-_./ A", max_size=8))
def test_a_name_is_one_of_a_package_or_is_refused(name: str) -> None:
    try:
        package = checked_package(name, set(), of="driver")
    except ValueError:
        return
    assert package.isidentifier()
    assert package == name.replace("-", "_")
