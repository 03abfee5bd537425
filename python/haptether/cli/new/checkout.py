"""Files and registry lines of one's own in the sources of Haptether."""

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import haptether

RUST_KEYWORDS = frozenset({
    "abstract", "as", "async", "await", "become", "box", "break", "const", "continue", "crate", "do", "dyn",
    "else", "enum", "extern", "final", "fn", "for", "gen", "if", "impl", "in", "let", "loop", "macro", "match",
    "mod", "move", "mut", "override", "priv", "pub", "ref", "return", "self", "static", "struct", "super", "trait",
    "try", "type", "typeof", "unsafe", "unsized", "use", "virtual", "where", "while", "yield", "true", "false",
})  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RegistryLine:
    """Text to be added to a file."""

    file: str
    """Path in the checkout."""
    after: str
    """Pattern after whose first match the text is inserted."""
    text: str


def checkout_of(given: Path | None, registry: str) -> Path:
    """Return the source checkout that has a registry.

    Args:
        given: Folder of the checkout; None for the one around the working folder, or else the one that this package
            runs from.
        registry: Path of the registry in it.

    Raises:
        ValueError: There is no checkout.
    """
    here = Path.cwd()
    places = [given] if given is not None else [here, *here.parents, Path(haptether.__file__).resolve().parents[2]]
    for place in places:
        if (place / registry).is_file():
            return place
    seen = f"{given or here}: no source checkout of Haptether (it has no {registry})"
    message = f"{seen}: clone the repository and run there, or give its folder by --checkout"
    raise ValueError(message)


def checked_module(module: str, folder: Path) -> Path:
    """Return the path of a new Rust module in a folder.

    Raises:
        ValueError: A keyword of Rust, or a module that is there.
    """
    if module in RUST_KEYWORDS:
        message = f"NAME = {module}: a keyword of Rust: take another, as my-{module}"
        raise ValueError(message)
    path = folder / f"{module}.rs"
    if path.exists() or (folder / module).exists():
        message = f"{path}: is there already: take another name"
        raise ValueError(message)
    return path


def module_line(registry: str, text: str, module: str) -> RegistryLine:
    """Return the `mod` line in alphabetical order.

    Args:
        registry: Path of the registry in the checkout.
        text: Its text.
        module: Name of the new module.
    """
    modules = re.findall(r"^(?:pub(?:\(crate\))? )?mod (\w+);$", text, re.MULTILINE)
    earlier = [other for other in modules if other < module]
    after = rf"\bmod {earlier[-1]};\n" if earlier else r"\n(?=(?:pub(?:\(crate\))? )?mod )"
    return RegistryLine(file=registry, after=after, text=f"mod {module};\n")


def add_lines(checkout: Path, lines: list[RegistryLine]) -> dict[Path, str]:
    """Return the new texts of the files with their lines; nothing is written.

    Raises:
        ValueError: A file has no place for its line.
    """
    texts: dict[Path, str] = {}
    for line in lines:
        path = checkout / line.file
        text = texts.get(path) or path.read_text(encoding="utf-8")
        found = re.search(line.after, text, re.MULTILINE)
        if found is None:
            message = f"{path}: has no place for the line: add it by hand: {line.text.strip()}"
            raise ValueError(message)
        texts[path] = text[: found.end()] + line.text + text[found.end() :]
    return texts


def write_sources(texts: dict[Path, str]) -> None:
    """Write files; those in Rust are formatted if rustfmt is installed.

    Raises:
        OSError: A file cannot be written.
    """
    for path, text in texts.items():
        path.write_text(_formatted(path, text), encoding="utf-8")


def _formatted(path: Path, text: str) -> str:
    if path.suffix != ".rs" or shutil.which("rustfmt") is None:
        return text
    # From standard input rustfmt formats this file only, with the settings of the folder it runs in.
    done = subprocess.run(
        ["rustfmt", "--edition", "2024"], input=text, cwd=path.parent, capture_output=True, text=True, check=False
    )
    return done.stdout if done.returncode == 0 and done.stdout else text
