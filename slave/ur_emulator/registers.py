"""The registers of a program: what clients wrote, and what it writes for them."""

import math
from collections.abc import Mapping, MutableMapping

from haptether.slave.ur_emulator.rtde_types import Value
from haptether.slave.ur_emulator.script_error import ScriptError

Six = tuple[float, ...]


class Registers:
    """Registers from an offset on: 0, or 24 for the range of external clients.

    Args:
        inputs: Values of the inputs, by name.
        outputs: Values of the outputs, by name.
        offset: Added to every number of a register.
    """

    def __init__(self, inputs: Mapping[str, Value], outputs: MutableMapping[str, Value], offset: int = 0) -> None:
        self._inputs = inputs
        self._outputs = outputs
        numbers = range(offset, 48)
        self._ints = [f"input_int_register_{number}" for number in numbers]
        self._doubles = [f"input_double_register_{number}" for number in numbers]
        self._offset = offset

    @property
    def command(self) -> str:
        """Name of the register that commands come in."""
        return self._ints[0]

    def integer(self, number: int) -> int:
        """An input register."""
        return self._inputs[self._ints[number]]  # type: ignore[return-value]  # the table says that it is an integer

    def double(self, number: int) -> float:
        """An input register."""
        return self._inputs[self._doubles[number]]  # type: ignore[return-value]  # the table says that it is a number

    def six(self, first: int) -> Six:
        """Six input registers."""
        inputs = self._inputs
        return tuple([inputs[name] for name in self._doubles[first : first + 6]])  # type: ignore[misc]

    def write_integer(self, number: int, value: int) -> None:
        """Writes an output register.

        Raises:
            ScriptError: No such register, or a number that it does not hold.
        """
        if not -(2**31) <= value < 2**31:
            message = f"output integer register {number} = {value}: must have 32 bits"
            raise ScriptError(message)
        self._write(f"output_int_register_{number + self._offset}", value)

    def write_double(self, number: int, value: float) -> None:
        """Writes an output register.

        Raises:
            ScriptError: No such register, or a number that is not finite.
        """
        if not math.isfinite(value):
            message = f"output double register {number} = {value}: must be finite"
            raise ScriptError(message)
        self._write(f"output_double_register_{number + self._offset}", value)

    def _write(self, name: str, value: float) -> None:
        if name not in self._outputs:
            message = f"{name}: there is no such register"
            raise ScriptError(message)
        self._outputs[name] = value

    def write_six(self, first: int, values: Six) -> None:
        """Writes six output registers."""
        for number, value in enumerate(values, start=first):
            self.write_double(number, value)
