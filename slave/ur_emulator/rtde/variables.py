"""RTDE variables: their types, the controller versions that have them, and the values of the inputs.

All types are big-endian on the wire, packed without padding.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", field types, tables of robot controller inputs and
outputs.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final, Self

Number = float | int | bool
Value = Number | tuple[Number, ...]
"""Scalar, or the components of a vector."""


@dataclass(frozen=True, slots=True)
class WireType:
    """Field type: its name in recipes, its `struct` code and its number of components."""

    name: str
    code: str
    count: int = 1

    @property
    def format(self) -> str:
        """Part of a `struct` format for this type."""
        return self.code * self.count

    @property
    def zero(self) -> Value:
        """Value of a variable before the first write."""
        number: Number = {"d": 0.0, "?": False}.get(self.code, 0)
        return number if self.count == 1 else (number,) * self.count


BOOL: Final = WireType("BOOL", "?")
UINT8: Final = WireType("UINT8", "B")
UINT32: Final = WireType("UINT32", "I")
UINT64: Final = WireType("UINT64", "Q")
INT32: Final = WireType("INT32", "i")
DOUBLE: Final = WireType("DOUBLE", "d")
VECTOR3D: Final = WireType("VECTOR3D", "d", 3)
VECTOR6D: Final = WireType("VECTOR6D", "d", 6)
VECTOR6INT32: Final = WireType("VECTOR6INT32", "i", 6)

NOT_FOUND: Final = "NOT_FOUND"
"""Replaces the type if the controller has no such variable."""
IN_USE: Final = "IN_USE"
"""Replaces the type if another client writes this input."""


# ------------------------------------------------------------------------------------------------------ versions

OLDEST_CB3, NEWEST_CB3 = (3, 15), (3, 15)
OLDEST_E, NEWEST_E = (5, 4), (5, 26)


@dataclass(frozen=True, slots=True, order=True)
class ControllerVersion:
    """Software version of a controller: CB3 has major 3, e-Series and UR-Series have major 5."""

    major: int
    minor: int
    bugfix: int = 0
    build: int = 0

    @classmethod
    def parsed(cls, text: str) -> Self:
        """Return a version from `5.11` or `5.11.10.108`.

        Raises:
            ValueError: The text has another form, or its series is not emulated.
        """
        found = re.fullmatch(r"(\d{1,3})\.(\d{1,3})(?:\.(\d{1,9}))?(?:\.(\d{1,9}))?", text)
        if not found:
            message = f"version = {text!r}: must be like 5.11 or 5.11.10.108"
            raise ValueError(message)
        version = cls(*(int(part or 0) for part in found.groups()))
        short = (version.major, version.minor)
        if not (OLDEST_CB3 <= short <= NEWEST_CB3 or OLDEST_E <= short <= NEWEST_E):
            message = f"version = {text}: must be 3.15 (CB3) or 5.4 to 5.26 (e-Series and UR-Series)"
            raise ValueError(message)
        return version

    @property
    def is_cb3(self) -> bool:
        """True for a third-generation controller."""
        return self.major == 3

    @property
    def rate_hz(self) -> int:
        """Control cycles per second: 125 (CB3) or 500."""
        return 125 if self.is_cb3 else 500

    def has(self, cb3: tuple[int, ...] | None, e_series: tuple[int, ...] | None) -> bool:
        """Return True if it is at least as new as the version of its series; None means never."""
        since = cb3 if self.is_cb3 else e_series
        return since is not None and (self.major, self.minor, self.bugfix) >= since

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.bugfix}.{self.build}"


# -------------------------------------------------------------------------------------------------------- tables

Since = tuple[tuple[int, ...] | None, tuple[int, ...] | None]
"""First version of CB3 and of e-Series controllers."""

ALWAYS: Final[Since] = ((3,), (5,))

_OUTPUTS: Final[tuple[tuple[WireType, Since, str], ...]] = (
    (
        DOUBLE,
        ALWAYS,
        (
            "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage"
            " actual_robot_voltage actual_robot_current io_current standard_analog_input0 standard_analog_input1"
            " standard_analog_output0 standard_analog_output1 tcp_force_scalar joint_position_deviation_ratio"
            " collision_detection_ratio tool_output_current tool_temperature tool_analog_input0 tool_analog_input1"
            " target_execution_time"
        ),
    ),
    (DOUBLE, ((3, 11), (5, 5, 1)), "payload"),
    (
        VECTOR6D,
        ALWAYS,
        (
            "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current"
            " actual_current_window joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force"
            " target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage"
        ),
    ),
    (VECTOR6D, ((3, 12, 3), (5, 5, 1)), "tcp_offset"),
    (VECTOR6D, (None, (5,)), "actual_TCP_acceleration target_TCP_acceleration"),
    (VECTOR6D, (None, (5, 9)), "ft_raw_wrench"),
    (VECTOR6D, ((3, 15), (5, 11)), "payload_inertia"),
    (VECTOR6D, (None, (5, 23)), "actual_current_as_torque"),
    (VECTOR3D, ALWAYS, "actual_tool_accelerometer elbow_position elbow_velocity"),
    (VECTOR3D, ((3, 11), (5, 5, 1)), "payload_cog"),
    (UINT64, ALWAYS, "actual_digital_input_bits actual_digital_output_bits"),
    (UINT64, (None, (5,)), "control_step"),
    (INT32, ALWAYS, "robot_mode safety_mode tool_output_voltage"),
    (INT32, ((3, 10), (5, 4)), "safety_status"),
    (
        UINT32,
        ALWAYS,
        (
            "runtime_state robot_status_bits safety_status_bits analog_io_types tool_mode tool_analog_input_types"
            " script_control_line output_bit_registers0_to_31 output_bit_registers32_to_63"
            " input_bit_registers0_to_31 input_bit_registers32_to_63"
        ),
    ),
    (VECTOR6INT32, ALWAYS, "joint_mode"),
    (UINT8, (None, (5,)), "tool_output_mode tool_digital_output0_mode tool_digital_output1_mode"),
)

_INPUTS: Final[tuple[tuple[WireType, Since, str], ...]] = (
    (UINT32, ALWAYS, "speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63"),
    (DOUBLE, ALWAYS, "speed_slider_fraction standard_analog_output_0 standard_analog_output_1"),
    (
        UINT8,
        ALWAYS,
        (
            "standard_digital_output standard_digital_output_mask configurable_digital_output"
            " configurable_digital_output_mask standard_analog_output_mask standard_analog_output_type"
        ),
    ),
    (UINT8, ALWAYS, "tool_digital_output tool_digital_output_mask"),
    (VECTOR6D, ((3, 3), (5,)), "external_force_torque"),
)

REGISTERS: Final = 48
UPPER_FROM: Final = 24
_LOWER_DOUBLES: Final[Since] = ((3, 4), (5,))
_UPPER: Final[Since] = ((3, 9), (5, 3))


def _registers(direction: str) -> Iterator[tuple[str, WireType, Since]]:
    for number in range(REGISTERS):
        upper = number >= UPPER_FROM
        yield f"{direction}_int_register_{number}", INT32, _UPPER if upper else _LOWER_DOUBLES
        yield f"{direction}_double_register_{number}", DOUBLE, _UPPER if upper else _LOWER_DOUBLES
    for number in range(64, 128):
        yield f"{direction}_bit_register_{number}", BOOL, _UPPER


def _table(
    version: ControllerVersion, rows: tuple[tuple[WireType, Since, str], ...], *registers: str
) -> dict[str, WireType]:
    named = ((name, kind, since) for kind, since, names in rows for name in names.split())
    numbered = (row for of in registers for row in _registers(of))
    return {name: kind for name, kind, since in (*named, *numbered) if version.has(*since)}


@cache
def outputs_of(version: ControllerVersion) -> dict[str, WireType]:
    """Return the outputs of a controller of this version, with their types."""
    return _table(version, _OUTPUTS, "output", "input")


@cache
def inputs_of(version: ControllerVersion) -> dict[str, WireType]:
    """Return the inputs of a controller of this version, with their types."""
    return _table(version, _INPUTS, "input")


# -------------------------------------------------------------------------------------------------------- inputs

NO_OWNER = 0


class RtdeInputs:
    """Values of the inputs, and the connection that may write each.

    Values persist until they are overwritten. A variable belongs to one connection until that connection ends.
    """

    def __init__(self, types: Mapping[str, WireType]) -> None:
        self.types = types
        self.values: dict[str, Value] = {name: kind.zero for name, kind in types.items()}
        self.writes: Counter[str] = Counter()
        """Number of writes of each input, changed or not."""
        self.refused = 0
        """Packages with a number that is not finite."""
        self.blocked: frozenset[str] = frozenset()
        """Inputs that no client gets, as if another client had them."""
        self.changed: set[str] = set()
        """Inputs written since this was last emptied."""
        self.on_written: Callable[[Mapping[str, Value]], None] = lambda _: None
        """Receives the values of each package once they are set."""
        self._owners: dict[str, int] = {}
        self._names = {name: name for name in types}

    def claim(
        self, owner: int, names: tuple[str, ...], *, wanted: bool = True
    ) -> tuple[list[str], tuple[WireType, ...] | None]:
        """Assign variables to a connection; return the answer for each, and their types (None if it gets none)."""
        answers = [self._answer(owner, name) for name in names]
        if not wanted or NOT_FOUND in answers or IN_USE in answers:
            return answers, None
        for name in self.known(names):
            self._owners[name] = owner
        return answers, tuple(self.types[name] for name in names)

    def known(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return the same names, as the objects of the table."""
        return tuple(self._names[name] for name in names)

    def release(self, owner: int) -> None:
        """Free the variables of a connection."""
        self._owners = {name: other for name, other in self._owners.items() if other != owner}

    def write(self, values: Mapping[str, Value]) -> None:
        """Set values; a package with a number that is not finite is refused as a whole."""
        for value in values.values():
            if not (math.isfinite(value) if isinstance(value, float | int) else all(map(math.isfinite, value))):
                self.refused += 1
                return
        self.values.update(values)
        self.changed.update(values)
        self.writes.update(values.keys())
        self.on_written(values)

    def _answer(self, owner: int, name: str) -> str:
        kind = self.types.get(name)
        if kind is None:
            return NOT_FOUND
        mine = self._owners.get(name, NO_OWNER if name in self.blocked else owner) == owner
        return kind.name if mine else IN_USE


DIGITAL_GROUPS = (("standard_digital_output", 0), ("configurable_digital_output", 8), ("tool_digital_output", 16))
"""Inputs that set digital outputs, and the first bit of each in the controller's outputs."""

DIGITAL_OUTPUTS = 18


ANALOG_MASK: Final = "standard_analog_output_mask"
SLIDER_MASK: Final = "speed_slider_mask"
LOWEST_A, HIGHEST_A = 0.004, 0.020
HIGHEST_V: Final = 10.0


class ClientSettings:
    """Digital outputs as bits, two analog outputs and the speed slider.

    Clients set them through inputs. A package sets them once, on arrival: others may change them afterwards.
    """

    def __init__(self, inputs: RtdeInputs) -> None:
        self._inputs = inputs
        inputs.on_written = self._apply
        self.reset()

    def reset(self) -> None:
        """Turn digital outputs off, set analog outputs to 4 mA and the slider to its end."""
        self.bits = 0
        self.slider = 1.0
        """Share of the speed, 0 to 1."""
        self._analog = [0.0, 0.0]
        """Share of the range of each analog output, 0 to 1."""
        self._is_voltage = [False, False]

    @property
    def analog(self) -> list[float]:
        """Return each analog output: 4 to 20 mA in A, or 0 to 10 V in V."""
        return [
            HIGHEST_V * share if voltage else LOWEST_A + (HIGHEST_A - LOWEST_A) * share
            for share, voltage in zip(self._analog, self._is_voltage, strict=True)
        ]

    @property
    def analog_types(self) -> int:
        """Return RTDE's `analog_io_types`: bits 2 and 3 are set for an analog output in V."""
        return self._is_voltage[0] << 2 | self._is_voltage[1] << 3

    def _apply(self, written: Mapping[str, Value]) -> None:
        """Apply the written inputs of a package."""
        for name, first in DIGITAL_GROUPS:
            if name in written:
                mask = self._integer(f"{name}_mask") << first
                self.bits = self.bits & ~mask | self._integer(name) << first & mask
        if ANALOG_MASK in written:
            for output in range(2):
                if self._integer(ANALOG_MASK) >> output & 1:
                    self._analog[output] = self._share(f"standard_analog_output_{output}")
                    self._is_voltage[output] = bool(self._integer("standard_analog_output_type") >> output & 1)
        if SLIDER_MASK in written and self._integer(SLIDER_MASK):
            self.slider = self._share("speed_slider_fraction")

    def _integer(self, name: str) -> int:
        return int(self._inputs.values[name])  # type: ignore[arg-type]  # the table says that it is an integer

    def _share(self, name: str) -> float:
        return min(max(float(self._inputs.values[name]), 0.0), 1.0)  # type: ignore[arg-type]  # DOUBLE

    def set(self, output: int, *, on: bool) -> None:
        """Set one bit (set_digital_out).

        Raises:
            ValueError: The output does not exist.
        """
        if not 0 <= output < DIGITAL_OUTPUTS:
            message = f"digital output {output}: must be between 0 and {DIGITAL_OUTPUTS - 1}"
            raise ValueError(message)
        self.bits = self.bits & ~(1 << output) | on << output
