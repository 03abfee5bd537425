"""Digital and analog outputs, which clients of RTDE set."""

from haptether.slave.ur_emulator.rtde_inputs import RtdeInputs

GROUPS = (("standard_digital_output", 0), ("configurable_digital_output", 8), ("tool_digital_output", 16))
"""Inputs of RTDE, and the bit of the controller's outputs where theirs begin."""

OUTPUTS = 18


class DigitalOutputs:
    """The bits that are set, and two analog shares."""

    def __init__(self, inputs: RtdeInputs) -> None:
        self.bits = 0
        self.analog = [0.0, 0.0]
        self._inputs = inputs
        self._seen = dict.fromkeys((*(name for name, _ in GROUPS), "standard_analog_output_mask"), 0)

    def update(self) -> None:
        """Takes over what has been written since the last time."""
        values, writes = self._inputs.values, self._inputs.writes
        for name, first in GROUPS:
            if writes[name] != self._seen[name]:
                self._seen[name] = writes[name]
                mask = int(values[f"{name}_mask"]) << first  # type: ignore[arg-type]  # UINT8
                self.bits = self.bits & ~mask | int(values[name]) << first & mask  # type: ignore[arg-type]
        name = "standard_analog_output_mask"
        if writes[name] != self._seen[name]:
            self._seen[name] = writes[name]
            for output in range(2):
                if int(values[name]) >> output & 1:  # type: ignore[arg-type]  # UINT8
                    share = float(values[f"standard_analog_output_{output}"])  # type: ignore[arg-type]  # DOUBLE
                    self.analog[output] = min(max(share, 0.0), 1.0)

    def reset(self) -> None:
        """All off."""
        self.bits = 0
        self.analog = [0.0, 0.0]

    def set(self, output: int, *, on: bool) -> None:
        """Sets one bit: set_digital_out.

        Raises:
            ValueError: No such output.
        """
        if not 0 <= output < OUTPUTS:
            message = f"digital output {output}: must be between 0 and {OUTPUTS - 1}"
            raise ValueError(message)
        self.bits = self.bits & ~(1 << output) | on << output
