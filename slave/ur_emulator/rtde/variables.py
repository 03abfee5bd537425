"""Variables of RTDE with their types, and from which version on a controller has them.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of robot controller inputs and outputs.
"""

from collections.abc import Iterator
from functools import cache
from typing import Final

from haptether.slave.ur_emulator.rtde_types import (
    BOOL,
    DOUBLE,
    INT32,
    UINT8,
    UINT32,
    UINT64,
    VECTOR3D,
    VECTOR6D,
    VECTOR6INT32,
    WireType,
)
from haptether.slave.ur_emulator.version import ControllerVersion

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

MISSING: Final = frozenset(
    {
        "actual_configurable_digital_input_bits", "actual_configurable_digital_output_bits",
        "actual_robot_energy_consumed", "actual_robot_braking_energy_dissipated", "encoder0_raw", "encoder1_raw",
        "euromap67_input_bits", "euromap67_output_bits", "euromap67_24V_voltage", "euromap67_24V_current",
        "wrench_calc_from_currents", "time_scale_source", "target_gravity", "target_base_acceleration",
        "target_base_wrench",
    }
)  # fmt: skip
"""Outputs of the guide that the emulator does not have: `NOT_FOUND`."""
ZERO: Final = frozenset(
    {
        "actual_execution_time", "target_execution_time", "actual_momentum", "actual_main_voltage",
        "actual_robot_voltage", "actual_robot_current", "actual_joint_voltage", "io_current", "standard_analog_input0",
        "standard_analog_input1", "joint_position_deviation_ratio", "collision_detection_ratio", "tool_output_current",
        "tool_temperature", "tool_analog_input0", "tool_analog_input1", "target_current", "target_moment",
        "actual_current", "actual_current_window", "actual_current_as_torque", "joint_control_output",
        "joint_temperatures", "actual_tool_accelerometer", "actual_digital_input_bits", "tool_output_voltage",
        "analog_io_types", "tool_mode", "tool_analog_input_types", "script_control_line", "tool_output_mode",
        "tool_digital_output0_mode", "tool_digital_output1_mode", "output_bit_registers0_to_31",
        "output_bit_registers32_to_63",
    }
)  # fmt: skip
"""Outputs that are served and stay 0: nothing of the emulator has such a value."""

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


def _registers(way: str) -> Iterator[tuple[str, WireType, Since]]:
    for number in range(REGISTERS):
        upper = number >= UPPER_FROM
        yield f"{way}_int_register_{number}", INT32, _UPPER if upper else _LOWER_DOUBLES
        yield f"{way}_double_register_{number}", DOUBLE, _UPPER if upper else _LOWER_DOUBLES
    for number in range(64, 128):
        yield f"{way}_bit_register_{number}", BOOL, _UPPER


def _table(
    version: ControllerVersion, rows: tuple[tuple[WireType, Since, str], ...], *registers: str
) -> dict[str, WireType]:
    named = ((name, kind, since) for kind, since, names in rows for name in names.split())
    numbered = (row for of in registers for row in _registers(of))
    return {name: kind for name, kind, since in (*named, *numbered) if version.has(*since)}


@cache
def outputs_of(version: ControllerVersion) -> dict[str, WireType]:
    """What a controller of this version can send."""
    return _table(version, _OUTPUTS, "output", "input")


@cache
def inputs_of(version: ControllerVersion) -> dict[str, WireType]:
    """What a controller of this version can be told."""
    return _table(version, _INPUTS, "input")
