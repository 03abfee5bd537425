"""Packages written from templates."""

import importlib.util
import keyword
import re
import shlex
import sys
from collections.abc import Collection, Mapping
from pathlib import Path

NAME = re.compile(r"[a-z][a-z0-9]*(?:-[a-z0-9]+)*")
MAX_NAME = 60
TEMPLATES = Path(__file__).parent / "templates"


def checked_name(name: str, taken: Collection[str], *, of: str) -> str:
    """Return the name as an identifier.

    Args:
        name: Name to check.
        taken: Names in use.
        of: Kind of the named thing, for the message.

    Raises:
        ValueError: An invalid name, or one in use.
    """
    if not NAME.fullmatch(name) or len(name) > MAX_NAME:
        message = f"NAME = {name[:80]}: must be small letters and digits with dashes between, as my-{of}"
        raise ValueError(message)
    if name in taken:
        message = f"NAME = {name}: {of} of this name exists already: take another, as my-{name}"
        raise ValueError(message)
    return name.replace("-", "_")


def checked_package(name: str, taken: Collection[str], *, of: str) -> str:
    """Return the package name; arguments and errors as of `checked_name`.

    Raises:
        ValueError: An invalid name, or the name of another package.
    """
    package = checked_name(name, taken, of=of)
    if keyword.iskeyword(package) or package in sys.stdlib_module_names or package in {"haptether", "tests"}:
        message = f"NAME = {name}: a package of this name is another one: take another, as my-{name}"
        raise ValueError(message)
    return package


def class_name(name: str) -> str:
    """Return `MyName` of `my-name`."""
    return "".join(part.capitalize() for part in name.split("-"))


def write_package(folder: Path, files: Mapping[str, str], words: Mapping[str, str]) -> None:
    """Write a package.

    Args:
        folder: Target, empty or new.
        files: Target file of each template; words are replaced in both.
        words: Replacement of each mark.

    Raises:
        ValueError: The folder is not empty.
        OSError: The folder cannot be written.
    """
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        message = f"{folder}: is there already: must be an empty folder, or none; give another by --out"
        raise ValueError(message)
    for template, target in files.items():
        path = folder / filled(target, words)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(from_template(filled(template, words), words), encoding="utf-8")


def from_template(template: str, words: Mapping[str, str]) -> str:
    """Return the text of a template with its marks replaced."""
    return filled((TEMPLATES / template).read_text(encoding="utf-8"), words)


def filled(text: str, words: Mapping[str, str]) -> str:
    """Return the text with its marks replaced."""
    for mark, word in words.items():
        text = text.replace(mark, word)
    return text


def install_line(folder: Path) -> str:
    """Return the command that installs a package into this process's environment, with pip or else uv."""
    if importlib.util.find_spec("pip") is not None:
        return shlex.join([sys.executable, "-m", "pip", "install", "-e", str(folder)])
    of_clone = Path(sys.prefix).parent / ".tools" / "uv" / "bin" / "uv"
    uv = str(of_clone) if of_clone.is_file() else "uv"
    return shlex.join([uv, "pip", "install", "--python", sys.executable, "-e", str(folder)])
