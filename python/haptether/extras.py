"""Optional libraries: the extra that installs each, and the error that names it."""

import importlib.util
import sys

EXTRAS = {
    "casadi": ("CasADi", "ur"),
    "cma": ("cma", "analysis"),
    "daqp": ("DAQP", "ur"),
    "distributed": ("dask.distributed", "cluster"),
    "matplotlib": ("matplotlib", "analysis"),
    "mcap": ("mcap", "record"),
    "PIL": ("Pillow", "view"),
    "polars": ("polars", "analysis"),
    "pyarrow": ("pyarrow", "parquet"),
    "pyvista": ("PyVista", "view"),
    "rtde_control": ("ur-rtde", "ur"),
    "scipy": ("SciPy", "analysis"),
    "starlette": ("Starlette", "console"),
    "uvicorn": ("uvicorn", "console"),
    "websockets": ("websockets", "haply"),
}
"""Name of the library and an extra that installs it, by module."""


def is_installed(module: str) -> bool:
    """Return True if a module can be imported, without importing it."""
    return importlib.util.find_spec(module) is not None


def missing(purpose: str, module: str, error: ImportError | None = None, extra: str | None = None) -> ImportError:
    """Return the error for a task whose library cannot be imported.

    Args:
        purpose: Subject of the message: "pictures", "the view".
        module: A key of `EXTRAS`.
        error: Exception of the import.
        extra: Extra that installs it; by default that of `EXTRAS`.
    """
    name, default = EXTRAS[module]
    if module == "rtde_control" and sys.version_info >= (3, 13):
        remedy = f"it has no wheels for Python {sys.version_info[0]}.{sys.version_info[1]}: use Python 3.11 or 3.12"
    else:
        remedy = f"install haptether[{extra or default}] (docs/install.md)"
    seen = f"cannot be loaded ({error})" if error is not None and is_installed(module) else "is not installed"
    return ImportError(f"{purpose}: {name} {seen}: {remedy}")


def require(purpose: str, *modules: str, extra: str | None = None) -> None:
    """Refuse a task whose libraries are not installed, before it begins.

    Args:
        purpose: Subject of the message: "pictures", "the view".
        modules: Keys of `EXTRAS`.
        extra: Extra that installs all of them; by default that of `EXTRAS`.

    Raises:
        ImportError: Names the first missing library and the extra.
    """
    for module in modules:
        if not is_installed(module):
            raise missing(purpose, module, extra=extra)
