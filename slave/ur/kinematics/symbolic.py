"""CasADi, imported by the first arm that is built, and its functions on memory of ours."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np

from haptether.extras import require
from haptether.slave.ur.kinematics.pose import Array, Numbers

Symbol: TypeAlias = Any
"""A casadi.SX."""


def casadi_module() -> Any:  # noqa: ANN401  # its own stubs leave out that a buffer takes a memoryview
    """The module `casadi`.

    Raises:
        ImportError: It is not installed.
    """
    require("kinematics of an arm", "casadi")
    return import_module("casadi")


class Buffered:
    """Expressions of one or more vectors, compiled to CasADi's virtual machine.

    `Function.buffer()` takes addresses once; a call then costs what its instructions cost, where `Function.__call__`
    first makes a matrix of every argument and result. Not to be shared between threads.

    Args:
        name: What CasADi calls it.
        arguments: Column vectors of symbols.
        results: Expressions of them.
        kept: How many of the last arguments `keep` sets, and no call.

    Raises:
        ValueError: From the calls: an argument has another length, or a number that is not finite.
    """

    __slots__ = ("_arguments", "_kept", "_probe", "_run", "_settings", "memory", "numbers", "results")

    def __init__(self, name: str, arguments: Sequence[Symbol], results: Sequence[Symbol], *, kept: int = 0) -> None:
        casadi = casadi_module()
        # Not finite as soon as one number is not, which a single result need not be.
        probe = sum(casadi.sum1(argument) for argument in arguments)
        dense = casadi.cse([casadi.densify(result) for result in (*results, probe)])
        function = casadi.Function(name, list(arguments), dense)
        buffer, self._run = function.buffer()
        # That an array is a buffer, and of what, is unknown to the types of Python 3.11.
        given: tuple[Any, ...] = tuple(np.zeros(argument.numel()) for argument in arguments)
        found: tuple[Any, ...] = tuple(np.zeros(result.numel()) for result in dense)
        for index, array in enumerate(given):
            buffer.set_arg(index, memoryview(array))
        for index, array in enumerate(found):
            buffer.set_res(index, memoryview(array))
        # CasADi has the addresses of all these, and does not keep them alive.
        self._kept = (function, buffer, given, found)
        views: tuple[Any, ...] = tuple(memoryview(array) for array in given)
        self._arguments = views[: len(views) - kept]
        self._settings = views[len(views) - kept :]
        self._probe: Any = memoryview(found[-1])
        self.memory: tuple[Array, ...] = found[:-1]
        """The results, column after column."""
        self.numbers: tuple[Any, ...] = tuple(memoryview(array) for array in found[:-1])
        """The same memory, to take single floats from."""
        self.results = tuple(_view(array, result.shape) for array, result in zip(found, dense, strict=True))[:-1]
        """The same memory as matrices that cannot be written to."""

    @property
    def given(self) -> tuple[Array, ...]:
        """A copy of the arguments of the last call."""
        return tuple(np.array(argument) for argument in self._arguments)

    def keep(self, index: int, vector: Array) -> None:
        """Sets one of the arguments that are kept, for all calls to come."""
        self._settings[index][:] = vector

    def one(self, vector: Numbers) -> None:
        """Fills the results of a function of one vector. An array of float64 is the fast way."""
        target = self._arguments[0]
        try:
            # Copies only between the same shapes and types, so it is the check as well.
            target[:] = vector
        except (TypeError, ValueError):
            target[:] = _converted(vector, len(target))
        self._run()
        seen = self._probe[0]
        if seen - seen != 0.0:
            raise self._not_finite()

    def all(self, *vectors: Numbers) -> None:
        """Fills the results of all arguments that are not kept."""
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
    # CasADi writes column after column.
    view = array.reshape(shape, order="F")
    view.flags.writeable = False
    return view
