"""CasADi, imported with the first arm, and its functions on preallocated memory."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np

from haptether.extras import require
from haptether.slave.ur.kinematics.pose import Array, Numbers

Symbol: TypeAlias = Any
"""A casadi.SX."""


def casadi_module() -> Any:  # noqa: ANN401  # its own stubs leave out that a buffer takes a memoryview
    """Return the module `casadi`.

    Raises:
        ImportError: CasADi is not installed.
    """
    require("kinematics of an arm", "casadi")
    return import_module("casadi")


class Buffered:
    """Expressions of one or more vectors, compiled to CasADi's virtual machine.

    `Function.buffer()` takes addresses once, so that a call costs only its instructions. `Function.__call__` would
    allocate a matrix per argument and result. Not thread-safe.

    Args:
        name: Name in CasADi.
        arguments: Column vectors of symbols.
        results: Expressions of the arguments.
        kept: Number of last arguments that `keep` sets, not a call.

    Raises:
        ValueError: A call has an argument of another length, or a non-finite value.
    """

    __slots__ = ("_arguments", "_kept", "_probe", "_run", "_settings", "memory", "numbers", "results")

    def __init__(self, name: str, arguments: Sequence[Symbol], results: Sequence[Symbol], *, kept: int = 0) -> None:
        casadi = casadi_module()
        # NaN if any argument is NaN, which a single result may not show.
        probe = sum(casadi.sum1(argument) for argument in arguments)
        dense = casadi.cse([casadi.densify(result) for result in (*results, probe)])
        function = casadi.Function(name, list(arguments), dense)
        buffer, self._run = function.buffer()
        # The types of Python 3.11 do not know arrays as buffers.
        given: tuple[Any, ...] = tuple(np.zeros(argument.numel()) for argument in arguments)
        found: tuple[Any, ...] = tuple(np.zeros(result.numel()) for result in dense)
        for index, array in enumerate(given):
            buffer.set_arg(index, memoryview(array))
        for index, array in enumerate(found):
            buffer.set_res(index, memoryview(array))
        # CasADi stores these addresses, but does not keep the arrays alive.
        self._kept = (function, buffer, given, found)
        views: tuple[Any, ...] = tuple(memoryview(array) for array in given)
        self._arguments = views[: len(views) - kept]
        self._settings = views[len(views) - kept :]
        self._probe: Any = memoryview(found[-1])
        self.memory: tuple[Array, ...] = found[:-1]
        """Results, column-major."""
        self.numbers: tuple[Any, ...] = tuple(memoryview(array) for array in found[:-1])
        """Same memory, for reading single floats."""
        self.results = tuple(_view(array, result.shape) for array, result in zip(found, dense, strict=True))[:-1]
        """Same memory as read-only matrices."""

    @property
    def given(self) -> tuple[Array, ...]:
        """Copy of the last call's arguments."""
        return tuple(np.array(argument) for argument in self._arguments)

    def keep(self, index: int, vector: Array) -> None:
        """Set a kept argument for all later calls."""
        self._settings[index][:] = vector

    def one(self, vector: Numbers) -> None:
        """Evaluate a function of one vector; a float64 array is fastest."""
        target = self._arguments[0]
        try:
            # Copies only between equal shapes and types, which also checks the argument.
            target[:] = vector
        except (TypeError, ValueError):
            target[:] = _converted(vector, len(target))
        self._run()
        seen = self._probe[0]
        if seen - seen != 0.0:
            raise self._not_finite()

    def all(self, *vectors: Numbers) -> None:
        """Evaluate with all arguments that are not kept."""
        for target, vector in zip(self._arguments, vectors, strict=True):
            try:
                target[:] = vector
            except (TypeError, ValueError):
                target[:] = _converted(vector, len(target))
        self._run()
        seen = self._probe[0]
        if seen - seen != 0.0:
            raise self._not_finite()

    def _not_finite(self) -> ValueError:
        seen = ", ".join(str(argument.tolist()) for argument in (*self._arguments, *self._settings))
        return ValueError(f"{seen}: every number must be finite")


def _converted(vector: Numbers, length: int) -> Array:
    array = np.ascontiguousarray(vector, dtype=np.float64)
    if array.shape != (length,):
        message = f"{array.tolist()}: must be {length} numbers"
        raise ValueError(message)
    return array


def _view(array: Array, shape: tuple[int, int]) -> Array:
    # CasADi writes column-major.
    view = array.reshape(shape, order="F")
    view.flags.writeable = False
    return view
