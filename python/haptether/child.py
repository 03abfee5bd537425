"""Child processes that import nothing from the user's working folder."""

import contextlib
import os
import sys
from collections.abc import Iterator, Mapping

SAFE_PATH = "PYTHONSAFEPATH"
"""Environment variable that stops an interpreter from importing from its working folder."""


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module in another interpreter, without the working folder on its path."""
    return [sys.executable, "-P", "-m", module, *arguments]


def child_environment(environment: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the environment of a child, with a safe path and only absolute folders in PYTHONPATH.

    An empty PYTHONPATH entry, for example from a trailing colon, means the working folder.
    """
    safe = {**environment, SAFE_PATH: "1"}
    if folders := safe.pop("PYTHONPATH", ""):
        safe["PYTHONPATH"] = os.pathsep.join(filter(os.path.isabs, folders.split(os.pathsep)))
    return safe


@contextlib.contextmanager
def safe_children() -> Iterator[None]:
    """Give interpreters that a library starts inside the context the environment of a child."""
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
