"""Processes of our own that import nothing from the working folder of their user."""

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping

SAFE_PATH = "PYTHONSAFEPATH"
"""With it an interpreter does not import from the folder that it is started in."""


def module_command(module: str, *arguments: str) -> list[str]:
    """The command that runs a module in another interpreter, without the working folder on its path."""
    return [sys.executable, "-P", "-m", module, *arguments]


def child_environment(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """The environment of a child: a safe path for it and its children, and only absolute folders in PYTHONPATH.

    An empty entry of PYTHONPATH, as a colon at its end makes, is the working folder.
    """
    safe = {**environment, SAFE_PATH: "1"}
    if folders := safe.pop("PYTHONPATH", ""):
        safe["PYTHONPATH"] = os.pathsep.join(filter(os.path.isabs, folders.split(os.pathsep)))
    return safe


@contextlib.contextmanager
def safe_children() -> Iterator[None]:
    """Within it, interpreters that a library starts have the environment of a child."""
    before = dict(os.environ)
    _set_environment(child_environment())
    try:
        yield
    finally:
        _set_environment(before)


def _set_environment(wanted: Mapping[str, str]) -> None:
    for name in (SAFE_PATH, "PYTHONPATH"):
        os.environ.pop(name, None)
        if name in wanted:
            os.environ[name] = wanted[name]
