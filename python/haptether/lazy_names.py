"""Public names of a package that load on first use (PEP 562)."""

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path


def lazy_names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of `package`, for the names that it imports under `if TYPE_CHECKING`."""
    module_of = _imported(Path(str(sys.modules[package].__file__)))

    def load(name: str) -> object:
        if (module := module_of.get(name)) is None:
            message = f"module {package!r} has no attribute {name!r}"
            raise AttributeError(message)
        try:
            found = import_module(module)
        except AttributeError as error:
            # An AttributeError would say that the name is missing, but not why.
            message = f"{module} cannot be loaded: {error}"
            raise ImportError(message) from error
        value = getattr(found, name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of})

    return load, names


def _imported(source: Path) -> dict[str, str]:
    """Return the module of each name that a source imports under `if TYPE_CHECKING`."""
    return {
        alias.name: imported.module
        for block in ast.parse(source.read_bytes()).body
        if isinstance(block, ast.If) and isinstance(block.test, ast.Name) and block.test.id == "TYPE_CHECKING"
        for imported in block.body
        if isinstance(imported, ast.ImportFrom) and imported.module is not None
        for alias in imported.names
    }
