"""No process that Haptether starts imports from the user's working folder."""

import ast
import multiprocessing
import os
import runpy
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.live.sides import Never

from haptether.bridge.scene.sweeps import cluster
from haptether.child import child_environment
from haptether.cli.live.panel_process import PanelProcess
from haptether.cli.new import checkout
from haptether.cli.setup import preflight
from haptether.slave.ur.worker import ControlProcess, ControlProcessError
from haptether.studies.processes import child_process

ROOT = Path(__file__).parents[2]
ROOMS = ("bridge", "dynamixel", "master", "netsim", "safety", "slave", "studies", "view", "examples")
NAMES = {*sys.stdlib_module_names, "haptether", "numpy", "msgspec", "tyro", "rich", "rtde_control", "rtde_receive"}
STARTERS = {
    "subprocess": {"Popen", "run", "call", "check_call", "check_output"},
    "os": {"system", "popen", "fork", "forkpty", "posix_spawn", "posix_spawnp", "execv", "execve", "execvp", "spawnv"},
    "multiprocessing": {"Process", "Pool", "get_context"},
    "distributed": {"LocalCluster"},
    "asyncio": {"create_subprocess_exec", "create_subprocess_shell"},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Create a working folder with a file for every importable name; each file notes its import."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'a').write('{name} ')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(("", ".", os.environ.get("PYTHONPATH", ""))))
    # Pytest adds further folders to the path of this process.
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    return tmp_path


def a_command() -> None:
    with child_process("inverse3-emulator", "--port", "0", "--event-port", "0", says="an Inverse3") as child:
        child.headline(Never())


def the_panel() -> None:
    panel = PanelProcess(Path("nobody.sock"))
    panel._writer.end(0.0)
    panel._pipe.close()
    assert panel._process.wait(30.0) == 0


def the_arm() -> None:
    pytest.importorskip("rtde_control")
    with socket.create_server(("127.0.0.1", 0)):
        control = ControlProcess("127.0.0.1", 125.0)
        try:
            with pytest.raises(ControlProcessError):
                control.connect()
        finally:
            control.kill()


def workers_of_a_cluster() -> None:
    class LocalCluster:
        """Starts an interpreter like a nanny of Dask."""

        def __init__(self, **_: object) -> None:
            process = multiprocessing.get_context("spawn").Process(target=os.getpid)
            process.start()
            process.join(30.0)
            assert process.exitcode == 0
            raise InterruptedError

    sys.modules["distributed"] = SimpleNamespace(LocalCluster=LocalCluster)  # type: ignore[assignment]
    try:
        settings = SimpleNamespace(threads=1)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cluster, "require", lambda *_: None)
            patch.setattr(cluster, "replace", lambda settings, **_: settings)
            rows = cluster.computed_by_cluster(None, None, (), None, settings, progress=None)  # type: ignore[arg-type]
            with pytest.raises(InterruptedError):
                next(rows)
    finally:
        del sys.modules["distributed"]


def an_example() -> None:
    example = runpy.run_path(str(ROOT / "examples" / "robotiq_gripper.py"), run_name="example")
    with example["emulated"]():
        pass


def a_check() -> None:
    status, report = preflight._run("netsim", "list", quiet=True)
    assert (status, report is None) == (0, False)


def a_formatter() -> None:
    path = Path("a.rs").absolute()
    assert checkout._formatted(path, "fn  main ( ) {}\n") in {"fn main() {}\n", "fn  main ( ) {}\n"}


def no_interpreter() -> None:
    source = (ROOT / "view" / "film.py").read_text(encoding="utf-8")
    assert "sys.executable" not in source
    assert '"ffmpeg", "-v"' in source


PLACES: dict[str, Callable[[], None]] = {
    "bridge/scene/sweeps/cluster.py": workers_of_a_cluster,
    "examples/robotiq_gripper.py": an_example,
    "python/haptether/cli/live/panel_process.py": the_panel,
    "python/haptether/cli/new/checkout.py": a_formatter,
    "python/haptether/cli/setup/preflight.py": a_check,
    "slave/ur/worker.py": the_arm,
    "studies/processes.py": a_command,
    "view/film.py": no_interpreter,
}


@pytest.mark.parametrize("place", PLACES)
def test_a_child_imports_nothing_from_the_working_folder(place: str, folder: Path) -> None:
    PLACES[place]()
    assert not (folder / "imported").exists(), (folder / "imported").read_text()


def test_these_are_all_places_that_start_a_process() -> None:
    sources = [
        file
        for room in (*ROOMS, "python/haptether")
        for file in (ROOT / room).rglob("*.py")
        if not any(parent.is_symlink() for parent in file.parents)
    ]
    found = {file.relative_to(ROOT).as_posix() for file in sources if starts(ast.parse(file.read_bytes()))}
    assert found == set(PLACES)


def starts(tree: ast.AST) -> bool:
    """Return true if a file calls, or imports, a function that starts a process."""
    used = {
        (node.value.id, node.attr)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
    }
    used |= {
        (node.module or "", name.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and not in_type_checking(tree, node)
        for name in node.names
    }
    return any(name in STARTERS.get(module, ()) for module, name in used)


def in_type_checking(tree: ast.AST, node: ast.AST) -> bool:
    return any(
        isinstance(one, ast.If) and ast.unparse(one.test) == "TYPE_CHECKING" and node in one.body
        for one in ast.walk(tree)
    )


def test_python_dash_m_imports_nothing_from_the_working_folder(folder: Path) -> None:
    command = [sys.executable, "-m", "haptether", "--version"]
    # The folder has no name that Python itself imports before our first line.
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    before = [sys.executable, "-I", "-c", "import runpy, sys; print(*sys.modules)"]
    early = subprocess.run(before, capture_output=True, text=True, timeout=60, check=True).stdout.split()
    for name in {"haptether", *early}:
        (folder / f"{name}.py").unlink(missing_ok=True)
    seen = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert seen.returncode == 0, seen.stderr
    assert not (folder / "imported").exists(), (folder / "imported").read_text()


@pytest.mark.parametrize(
    ("before", "after"),
    [(None, None), ("", None), (":/opt/ros", "/opt/ros"), ("/opt/ros:", "/opt/ros"), (".:src:/a:/b", "/a:/b")],
)
def test_the_path_of_a_child_has_only_absolute_folders(before: str | None, after: str | None) -> None:
    environment = {} if before is None else {"PYTHONPATH": before}
    safe = {"PYTHONSAFEPATH": "1"} | ({} if after is None else {"PYTHONPATH": after})
    assert child_environment(environment) == safe
