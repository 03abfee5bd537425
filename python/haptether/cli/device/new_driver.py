"""`haptether new-driver`."""

import importlib.util
import keyword
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

NAME = re.compile(r"[a-z][a-z0-9]*(?:-[a-z0-9]+)*")
MAX_NAME = 60
FILES = {
    "common/pyproject.toml.txt": "pyproject.toml",
    "common/__init__.py.txt": "src/@PACKAGE@/__init__.py",
    "@SIDE@/README.md.txt": "README.md",
    "@SIDE@/driver.py.txt": "src/@PACKAGE@/driver.py",
    "@SIDE@/test_driver.py.txt": "tests/test_driver.py",
}
"""Target file of each template."""


@dataclass(frozen=True, kw_only=True)
class NewDriver:
    """Write a package with a driver of your own: it can be installed, runs with a model, and has a test.

    docs/new_device.md explains each step. Marks in src/.../driver.py show the places to fill in.

    Examples:

    haptether new-driver master my-stylus

    haptether new-driver slave my-arm --out drivers/my-arm
    """

    side: Annotated[Literal["master", "slave"], tyro.conf.Positional]
    """A haptic device (master) or an arm (slave)."""
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """Name of the driver and of its package: small letters, digits, and dashes between."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Target folder, empty or new; by default NAME, here."""

    def run(self) -> int:
        """Write the files.

        Raises:
            ValueError: A name that no package can have, or a folder that is not empty.
            OSError: The folder cannot be written.
        """
        package = checked_package(self.name)
        folder = Path(self.name) if self.out is None else self.out
        if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
            message = f"{folder}: is there already: must be an empty folder, or none; give another by --out"
            raise ValueError(message)
        words = {
            "@NAME@": self.name,
            "@PACKAGE@": package,
            "@CLASS@": "".join(part.capitalize() for part in self.name.split("-")),
            "@GROUP@": f"haptether.{self.side}s",
            "@SIDE@": self.side,
        }
        templates = Path(__file__).parent / "templates"
        for template, target in FILES.items():
            path = folder / _filled(target, words)
            path.parent.mkdir(parents=True, exist_ok=True)
            text = (templates / _filled(template, words)).read_text(encoding="utf-8")
            path.write_text(_filled(text, words), encoding="utf-8")
        print(f"{folder}: a driver of a {self.side}, to be filled in: {folder}/src/{package}/driver.py")
        print(f"next: {install_line(folder)} && haptether check-device {self.name}")
        return 0


def install_line(folder: Path) -> str:
    """Return the command that installs a package into this process's environment, with pip or else uv."""
    if importlib.util.find_spec("pip") is not None:
        return shlex.join([sys.executable, "-m", "pip", "install", "-e", str(folder)])
    of_clone = Path(sys.prefix).parent / ".tools" / "uv" / "bin" / "uv"
    uv = str(of_clone) if of_clone.is_file() else "uv"
    return shlex.join([uv, "pip", "install", "--python", sys.executable, "-e", str(folder)])


def checked_package(name: str) -> str:
    """Return the package name of a driver.

    Raises:
        ValueError: An invalid name, or the name of another package.
    """
    from haptether.bridge import MASTERS, SLAVES, device_names

    if not NAME.fullmatch(name) or len(name) > MAX_NAME:
        message = f"NAME = {name[:80]}: must be small letters and digits with dashes between, as my-stylus"
        raise ValueError(message)
    package = name.replace("-", "_")
    if keyword.iskeyword(package) or package in sys.stdlib_module_names or package in {"haptether", "tests"}:
        message = f"NAME = {name}: a package of this name is another one: take another, as my-{name}"
        raise ValueError(message)
    if name == "simulated" or name in {*device_names(MASTERS), *device_names(SLAVES)}:
        message = f"NAME = {name}: a driver of this name is installed already (haptether list): take another"
        raise ValueError(message)
    return package


def _filled(text: str, words: dict[str, str]) -> str:
    for mark, word in words.items():
        text = text.replace(mark, word)
    return text
