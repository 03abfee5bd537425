"""Rules of the tree that no compiler checks: public names, clocks and imports between rooms."""

import ast
import contextlib
import importlib
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from haptether import _core
from haptether.lazy_names import lazy_names

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "python" / "haptether"

CRATES = ("safety", "netsim", "dynamixel", "master", "slave", "bridge")

# Rooms that the Python files of a room may import: those that its crate may use. `studies` and `view` have no crate; a
# recording is read through the bridge.
MAY_IMPORT = {
    "safety": frozenset[str](),
    "netsim": frozenset[str](),
    "dynamixel": frozenset[str](),
    "master": frozenset({"dynamixel"}),
    "slave": frozenset({"dynamixel"}),
    "bridge": frozenset({"safety", "netsim", "dynamixel", "master", "slave"}),
    "studies": frozenset(CRATES),
    "view": frozenset({"bridge", "dynamixel", "slave", "master"}),
}
# The part of `view` that draws from arrays: it uses no other room, so rooms with arrays may use it.
DRAWING = ("haptether.view.style", "haptether.view.figures")
MAY_DRAW = frozenset({"bridge", "studies"})
ROOMS = tuple(room for room in MAY_IMPORT if (PACKAGE / room).exists())
PACKAGES = ("haptether", *(f"haptether.{room}" for room in ROOMS))

# Only the runners and their threads may read a clock in Rust.
CLOCK_OWNERS = ("live", "proxy", "recorder", "telemetry", "writer")
CLOCK = re.compile(
    r"\bInstant\b|\bSystemTime\b|\bUNIX_EPOCH\b|\bclock_gettime\b|\bclock_nanosleep\b"
    r"|\bnanosleep\b|\bthread::sleep\b|\bsleep(_ms|_until)?\s*\("
)

HEAVY = ("casadi", "matplotlib", "pyvista", "scipy", "vtkmodules")


@pytest.mark.parametrize("module", PACKAGES)
def test_a_star_import_gives_the_names_it_promises(module: str) -> None:
    promised = importlib.import_module(module).__all__
    names: dict[str, object] = {}
    exec(f"from {module} import *", names)
    assert sorted(promised) == sorted(set(promised))
    assert set(promised) <= names.keys()


def public_objects(module: str) -> dict[str, object]:
    """Return the classes and functions of ours that a package offers, whether or not `__all__` has them."""
    package = importlib.import_module(module)
    offered = {name: getattr(package, name) for name in dir(package) if not name.startswith("_")}
    return {
        name: value
        for name, value in offered.items()
        if (inspect.isclass(value) or inspect.isroutine(value))
        and (value.__module__ or "").split(".")[0] == "haptether"
        and value is not lazy_names
    }


@pytest.mark.parametrize("module", PACKAGES)
def test_all_has_every_public_class_and_function(module: str) -> None:
    assert sorted(set(public_objects(module)) - set(importlib.import_module(module).__all__)) == []


def test_each_class_of_the_extension_is_where_its_name_says() -> None:
    wrong = [
        f"{kind.__module__}.{kind.__name__}"
        for kind in filter(inspect.isclass, (getattr(_core, name) for name in _core.__all__))
        if kind.__module__ != "haptether._core"
        and kind.__name__ not in importlib.import_module(kind.__module__).__all__
    ]
    assert wrong == []


@pytest.mark.parametrize("module", PACKAGES)
def test_the_page_lists_every_public_name(module: str) -> None:
    page = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    (names,) = re.findall(rf"^{re.escape(module)}: (.*(?:\n  .*)*)", page, re.MULTILINE)
    assert " ".join(names.split()) == ", ".join(importlib.import_module(module).__all__)


def described(name: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield a class with its methods and properties, or a function, each with its dotted name."""
    yield name, value
    if inspect.isclass(value):
        for owner in value.__mro__:
            if owner.__module__.split(".")[0] == "haptether":
                for member in filter(lambda member: not member.startswith("_"), vars(owner)):
                    found = inspect.getattr_static(value, member)
                    if inspect.isroutine(found) or inspect.isgetsetdescriptor(found) or isinstance(found, property):
                        yield f"{name}.{member}", getattr(value, member)


def faults_of_help(name: str, value: object) -> Iterator[str]:
    """Yield what `help()` of a public object lacks: a docstring, or the value of a default."""
    if not (getattr(value, "__doc__", None) or "").strip():
        yield f"{name}: no docstring"
    if callable(value):
        with contextlib.suppress(ValueError):  # an exception class has no signature
            for parameter in inspect.signature(value).parameters.values():
                if parameter.default is ...:
                    yield f"{name}: the default of {parameter.name} is not shown"


@pytest.mark.parametrize("module", PACKAGES)
def test_help_explains_every_public_name_with_its_defaults(module: str) -> None:
    offered = public_objects(module)
    wrong = [
        fault
        for name, value in offered.items()
        for each, part in described(name, value)
        for fault in faults_of_help(each, part)
    ]
    assert wrong == []


def test_faults_of_help_are_found() -> None:
    class Undocumented:
        @property
        def size(self) -> float:
            return 0.0

        def scale(self, by: float = ...) -> float:  # type: ignore[assignment]
            """Return the product."""
            return by

    Undocumented.__module__ = "haptether.example"
    faults = [fault for each, part in described("X", Undocumented) for fault in faults_of_help(each, part)]
    assert faults == ["X: no docstring", "X.size: no docstring", "X.scale: the default of by is not shown"]


@pytest.mark.parametrize("room", ["numeric", *CRATES])
def test_no_clock_is_read_outside_the_live_runner(room: str) -> None:
    readers = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in sorted((ROOT / room / "src").rglob("*.rs"))
        if not any(p.startswith(CLOCK_OWNERS) for p in path.relative_to(ROOT / room / "src").parts)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if CLOCK.search(line.partition("//")[0])
    ]
    assert not readers


def test_the_clock_is_recognised() -> None:
    for line in (
        "let now = Instant::now();",
        "std::time::SystemTime::now()",
        "rustix::time::clock_gettime(ClockId::Monotonic)",
        "thread::sleep(pause)",
        "spin_sleep::sleep(pause)",
        "libc::nanosleep(&request, null_mut())",
    ):
        assert CLOCK.search(line)
    for line in ("let instant_ns = now_ns;", "fn asleep(&self)", "self.sleeping"):
        assert not CLOCK.search(line)


def imports(path: Path, package: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Yield line and full dotted name of each import of a file.

    `package` is the dotted name of the file's folder, which relative imports need.
    """
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            start = (*base, node.module) if node.module else base
            for alias in node.names:
                yield node.lineno, ".".join((*start, alias.name))


def python_files(room: str) -> Iterator[tuple[Path, tuple[str, ...]]]:
    for path in sorted((ROOT / room).rglob("*.py")):
        yield path, ("haptether", *path.relative_to(ROOT).parent.parts)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_the_rooms_its_crate_may_use(room: str) -> None:
    # The command line is above all rooms, and `import haptether` alone would reach every room.
    forbidden = {*MAY_IMPORT, "cli", ""} - MAY_IMPORT[room] - {room}
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path, package in python_files(room)
        for line, name in imports(path, package)
        if name.split(".")[0] == "haptether"
        and (*name.split("."), "")[1] in forbidden
        and not (room in MAY_DRAW and name.startswith(DRAWING))
    ]
    assert not wrong


@pytest.mark.parametrize("folder", ["style", "figures"])
def test_what_draws_from_arrays_uses_no_other_room(folder: str) -> None:
    others = {*MAY_IMPORT, "cli", ""} - {"view"}
    allowed = (*DRAWING, "haptether.view.scene3d.colours")
    files = [(path, package) for path, package in python_files("view") if path.parent.name == folder]
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path, package in files
        for line, name in imports(path, package)
        if name.split(".")[0] == "haptether"
        and (
            (*name.split("."), "")[1] in others or (name.startswith("haptether.view") and not name.startswith(allowed))
        )
    ]
    assert len(files) > 3
    assert not wrong


def test_studies_use_public_names_only() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path, package in python_files("studies")
        for line, name in imports(path, package)
        if name.startswith("haptether.")
        and not name.startswith("haptether.studies")
        and any(part.startswith("_") and not part.endswith("__") for part in name.split("."))
    ]
    assert not wrong


def test_relative_imports_are_resolved(tmp_path: Path) -> None:
    file = tmp_path / "module.py"
    file.write_text("from .. import bridge\nfrom ..safety.x import y\nfrom . import z\nimport a.b")
    assert [name for _, name in imports(file, ("haptether", "netsim"))] == [
        "haptether.bridge",
        "haptether.safety.x.y",
        "haptether.netsim.z",
        "a.b",
    ]


def heavy_modules(program: str) -> str:
    """Return which of the heavy libraries a program has loaded when it ends."""
    report = f"print('loaded:', *sorted(set({HEAVY!r}) & set(sys.modules)))"
    answer = subprocess.run(
        [sys.executable, "-c", f"import sys\n{program}\n{report}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    return answer.stdout.rpartition("loaded:")[2].strip()


@pytest.mark.parametrize(
    "module", ["haptether", *(f"haptether.{room}" for room in CRATES), "haptether.slave.robotiq.driver"]
)
def test_an_import_loads_nothing_heavy(module: str) -> None:
    assert heavy_modules(f"import {module}") == ""


def test_the_help_loads_nothing_heavy() -> None:
    program = """
from haptether.cli import main
sys.argv = ["haptether", "--help"]
try:
    status = main()
except SystemExit as end:
    status = end.code
assert not status, status
"""
    assert heavy_modules(program) == ""


def test_names_that_load_on_first_use_are_those_that_type_checkers_see(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "lazy_package"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from typing import TYPE_CHECKING\n"
        "from haptether.lazy_names import lazy_names\n"
        "if TYPE_CHECKING:\n"
        "    from lazy_package.sound import first, second\n"
        "    from lazy_package.broken import third\n"
        "if not TYPE_CHECKING:\n"
        "    __getattr__, __dir__ = lazy_names(__name__)\n"
    )
    (package / "sound.py").write_text("first, second = 1, 2\n")
    (package / "broken.py").write_text("import sys\nthird = sys.no_such_name\n")
    lazy = importlib.import_module("lazy_package")
    assert "lazy_package.sound" not in sys.modules
    assert {"first", "second", "third"} <= set(dir(lazy))
    assert (lazy.second, vars(lazy)["second"]) == (2, 2)
    with pytest.raises(AttributeError, match="'lazy_package' has no attribute 'fourth'"):
        _ = lazy.fourth
    with pytest.raises(ImportError, match=r"lazy_package\.broken cannot be loaded: module 'sys' has no"):
        _ = lazy.third
