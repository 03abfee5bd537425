"""Wheel, source distribution and lock match the tree.

Maturin follows the links from python/haptether to the rooms; its documentation does not promise it. Both archives are
therefore built here and compared file by file.
"""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "tools" / "requirements.txt"
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
CRATES = ("numeric", "safety", "netsim", "dynamixel", "master", "slave", "bridge", "python")

building = pytest.mark.timeout(400)


def tree() -> list[PurePosixPath]:
    """Return the files of the repository: tracked and untracked files of git, or without git the files on disk."""
    git = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    paths: list[Path] = []
    if (ROOT / ".git").exists() and shutil.which("git"):
        listing = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=False).stdout
        paths = [ROOT / name for name in listing.split("\0") if name]
    if not paths:
        made = {"target", "dist", "out", "__pycache__"}
        for folder, folders, names in os.walk(ROOT):
            folders[:] = [name for name in folders if name not in made and name[0] != "."]
            paths += [Path(folder, name) for name in names if not name.endswith(".so")]
    return sorted(PurePosixPath(path.relative_to(ROOT)) for path in paths if path.is_file())


def packaged() -> Iterator[str]:
    """Yield the place of each file of the Python package in the wheel, without the extension."""
    links = [path for path in (ROOT / "python" / "haptether").iterdir() if path.is_symlink()]
    rooms = {link.resolve().name: link.name for link in links}
    for path in tree():
        if path.parts[:2] == ("python", "haptether"):
            yield str(path.relative_to("python"))
        elif path.parts[0] in rooms and not cargo_only(path):
            yield str(PurePosixPath("haptether", rooms[path.parts[0]], *path.parts[1:]))


def cargo_only(path: PurePosixPath) -> bool:
    """Return true if a file of a room is useless without a Rust compiler."""
    return path.suffix == ".rs" or path.parts[1] in {"src", "Cargo.toml"} or "proptest-regressions" in path.parts


UNOPTIMISED = {"CARGO_PROFILE_DEV_OPT_LEVEL": "0", "CARGO_PROFILE_DEV_DEBUG": "0"}
"""Settings for builds whose files are only listed: 1 min instead of 3."""


def maturin(*arguments: str, cwd: Path = ROOT, target: Path = TARGET) -> None:
    environment = os.environ | UNOPTIMISED | {"CARGO_TARGET_DIR": str(target), "VIRTUAL_ENV": sys.prefix}
    answer = subprocess.run(
        [sys.executable, "-m", "maturin", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert answer.returncode == 0, answer.stdout + answer.stderr


PROFILE = (ROOT / ".tools" / "profile").read_text("utf-8").strip()
"""Profile of the editable installation, whose compiled files the wheel reuses."""


def build_wheel(out: Path, cwd: Path = ROOT, target: Path = TARGET, profile: str = PROFILE) -> Path:
    python = ["--interpreter", sys.executable]
    maturin("build", "--profile", profile, "--locked", *python, "--out", str(out), cwd=cwd, target=target)
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the wheel, built from the compiled files of the editable installation."""
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the source distribution."""
    out = tmp_path_factory.mktemp("sdist")
    maturin("sdist", "--out", str(out))
    (archive,) = out.glob("*.tar.gz")
    return archive


def contents(wheel: Path) -> tuple[list[str], list[str]]:
    """Return the files of a wheel: those of the package, and those of its description."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/")]
    described = [name for name in names if name.split("/")[0].endswith(".dist-info")]
    return sorted(set(names) - set(described)), described


@building
def test_the_wheel_holds_the_package_and_the_rooms_and_nothing_else(wheel: Path) -> None:
    names, described = contents(wheel)
    extension = [name for name in names if name.endswith((".so", ".pyd", ".dylib"))]
    assert len(extension) == 1
    assert re.fullmatch(r"haptether/_core\.(abi3\.so|pyd)", extension[0])
    assert "abi3" in wheel.name
    assert names == sorted([*packaged(), *extension])
    assert {"haptether/__init__.py", "haptether/py.typed", "haptether/_core.pyi"} <= set(names)
    ends = {name.partition(".dist-info/")[2] for name in described}
    assert {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"} <= ends


@building
def test_the_wheel_lists_the_crates_of_the_lock(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if "/sboms/" in name]
        text = archive.read(name).decode()
    current = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "sbom.py")], capture_output=True, text=True, check=True
    )
    assert text == current.stdout, "run `make lock`"
    assert str(ROOT) not in text


@building
def test_no_file_is_in_the_wheel_twice(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert len(names) == len(set(names))


@building
def test_the_sdist_holds_the_sources_of_both_languages_once(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        members = [member.name.partition("/")[2] for member in archive if not member.isdir()]
    root = [
        "Cargo.toml",
        "Cargo.lock",
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "PKG-INFO",
        "python/haptether.cdx.json",
    ]
    rust = [
        str(path)
        for path in tree()
        if path.parts[0] in CRATES and (path.suffix == ".rs" or path.parts[1] == "src" or path.name == "Cargo.toml")
    ]
    assert sorted(members) == sorted([*root, *rust, *(f"python/{name}" for name in packaged())])


@pytest.mark.thorough
@building
def test_the_sdist_builds_the_same_wheel(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    # The build has one fixed place, so that cargo replaces its files instead of piling them up. Extraction sets new
    # times, because cargo would take the archive's fixed times for unchanged sources. It has its own target folder,
    # because in the repository's, cargo would take the unpacked sources for those of the next build.
    place = TARGET / "from-sdist"
    shutil.rmtree(place, ignore_errors=True)
    with tarfile.open(sdist) as archive:
        archive.extractall(place, filter="data")
    (source,) = place.iterdir()
    now = time.time()
    for path in source.rglob("*"):
        os.utime(path, (now, now))
    of_sdist = build_wheel(tmp_path, cwd=source, target=TARGET / "of-sdist", profile="dev")
    assert contents(of_sdist)[0] == contents(wheel)[0]


UV = os.environ.get("UV", str(ROOT / ".tools" / "uv" / "bin" / "uv"))


def interpreters() -> dict[str, str]:
    """Return the interpreters of this machine by version, with those of pyenv."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    found: dict[str, str] = {}
    for version in ("3.11", "3.12", "3.13", "3.14"):
        name = f"python{version}"
        for program in filter(None, [shutil.which(name), *sorted(map(str, pyenv.glob(f"versions/*/bin/{name}")))]):
            # A pyenv shim also exists for versions that are not selected, and fails.
            if subprocess.run([program, "-c", "import venv"], capture_output=True, check=False).returncode == 0:
                found.setdefault(version, program)
    return found


PYTHONS = interpreters()
IS_RELEASE = (ROOT / ".tools" / "profile").read_text().strip() == "release"
MAX_INSTALLED_MB = 90 if IS_RELEASE else 97
"""A release has 7 MB less of machine code than a quick build, which is not shipped."""


def install(version: str, wheel: Path, folder: Path) -> Path:
    """Make a clean environment with the wheel and its requirements only."""
    place = folder / version
    subprocess.run([UV, "venv", "--quiet", "--python", PYTHONS[version], str(place)], check=True)
    arguments = ["--quiet", "--python", str(place / "bin" / "python"), str(wheel)]
    subprocess.run([UV, "pip", "install", *arguments], check=True, timeout=300)
    return place


@pytest.fixture(scope="session")
def newest(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an installation of the wheel in the newest interpreter of this machine."""
    return install(max(PYTHONS), wheel, tmp_path_factory.mktemp("newest"))


def haptether(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    command = [str(place / "bin" / "haptether"), *arguments]
    return subprocess.run(
        command, cwd=place, env=environment, capture_output=True, text=True, timeout=120, check=False
    )  # fmt: skip


@building
@pytest.mark.parametrize("version", PYTHONS)
def test_the_wheel_alone_is_small_and_runs(version: str, wheel: Path, tmp_path: Path) -> None:
    installed = install(version, wheel, tmp_path)
    (site,) = installed.glob("lib/python*/site-packages")
    files = [path for path in site.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert sum(path.stat().st_size for path in files) < MAX_INSTALLED_MB * 1e6
    for arguments in (["simulate", "remote_push"], ["check", "paper_wall"], ["console", "--help"], ["list"]):
        answer = haptether(installed, *arguments)
        assert answer.returncode == 0, answer.stderr
        assert answer.stdout


@building
def test_the_wheel_alone_shows_the_demo_without_a_picture(newest: Path) -> None:
    answer = haptether(newest, "demo")
    assert answer.returncode == 0, answer.stderr
    assert "no picture: drawing: matplotlib is not installed: install haptether[analysis]" in answer.stdout


NEEDS_EXTRA = [
    (["view", "remote_push"], "view"),
    (["console", "--connect", "none"], "console"),
    (["simulate", "remote_push", "--plot", "a.png"], "analysis"),
    (["sweep", "remote_push", "--samples", "2", "--out", "a.parquet"], "parquet"),
    (["sweep", "remote_push", "--samples", "2", "--plot", "a.png"], "analysis"),
    (["falsify", "remote_push"], "analysis"),
    (["paper", "--plot", "out"], "analysis"),
    (["ur-emulator"], "ur"),
    (["demo", "--slave", "ur"], "ur"),
    (["inverse3-emulator"], "haply"),
]


@building
@pytest.mark.parametrize(("arguments", "extra"), NEEDS_EXTRA, ids=[" ".join(one) for one, _ in NEEDS_EXTRA])
def test_a_command_names_the_extra_before_it_computes(newest: Path, arguments: list[str], extra: str) -> None:
    answer = haptether(newest, *arguments)
    assert answer.returncode == 1, answer.stdout
    assert f"install haptether[{extra}]" in answer.stderr


def locked() -> list[Requirement]:
    """Return the lines of the lock without their hashes."""
    text = LOCK.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.lstrip().startswith("#")]
    assert all("--hash=sha256:" in line for line in lines)
    return [Requirement(line.partition("--hash")[0]) for line in lines]


def test_the_lock_names_no_place() -> None:
    for path in (LOCK, LOCK.with_name("uv.txt")):
        text = path.read_text(encoding="utf-8")
        assert "://" not in text
        assert not re.search(r"^-", text, re.MULTILINE)


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
def test_the_lock_meets_the_project_on_each_python(version: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wanted = [
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["analysis"],
        *project["dependency-groups"]["dev"],
    ]
    python = {"python_version": version, "python_full_version": f"{version}.0"}
    pins: dict[str, list[str]] = {}
    for pin in locked():
        if pin.marker is None or pin.marker.evaluate(python):
            pins.setdefault(canonicalize_name(pin.name), []).append(str(pin.specifier))
    assert all(len(versions) == 1 for versions in pins.values())
    for need in map(Requirement, wanted):
        if need.marker is None or need.marker.evaluate(python):
            (pin_text,) = pins[canonicalize_name(need.name)]
            assert need.specifier.contains(pin_text.removeprefix("==")), f"`make lock`: {need}"
