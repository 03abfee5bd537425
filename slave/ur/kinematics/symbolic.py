"""CasADi, imported by the first arm that is built and not before."""

from importlib import import_module
from typing import Any, TypeAlias

Symbol: TypeAlias = Any
"""A casadi.SX."""


def casadi_module() -> Any:  # noqa: ANN401  # its own stubs leave out that a buffer takes a memoryview
    """The module `casadi`."""
    return import_module("casadi")
