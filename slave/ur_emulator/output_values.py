"""What RTDE tells of the controller in a control cycle."""

import math
from typing import TYPE_CHECKING

import numpy as np

from haptether.slave.ur_emulator.robot.kinematics import Six, six
from haptether.slave.ur_emulator.robot_state import (
    JOINT_MODES,
    JOINT_POWER_OFF,
    RuntimeState,
    robot_status_bits,
    safety_status_bits,
)
from haptether.slave.ur_pose import pose_from_transform

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.controller import Controller
    from haptether.slave.ur_emulator.rtde_types import Value


class OutputValues:
    """Writes the outputs that the emulator models; all others stay zero."""

    def __init__(self, controller: "Controller") -> None:
        self._of = controller
        self._before: tuple[Six, Six] = ((0.0,) * 6, (0.0,) * 6)
        """Velocities of the tool a control cycle ago, of the target and as measured."""

    def update(self) -> None:
        """Brings the outputs up to date."""
        of = self._of
        outputs, robot = of.outputs, of.robot
        measured, target = robot.measured, robot.target
        tool, jacobian = robot.arm.transform_and_jacobian(target.q)
        robot.tool_speed = math.hypot(*(target_velocity := six(jacobian @ np.array(target.qd)))[:3])
        elbow, elbow_velocity = robot.arm.elbow(measured.q, measured.qd)
        velocities = target_velocity, measured.velocity
        target_acceleration, acceleration = (
            tuple([(new - old) / of.period_s for new, old in zip(now, before, strict=True)])
            for now, before in zip(velocities, self._before, strict=True)
        )
        self._before = velocities
        playing = of.runtime == RuntimeState.PLAYING
        safety = of.safety
        values: dict[str, Value] = {
            "timestamp": of.timestamp,
            "speed_scaling": of.limiter,
            "target_speed_fraction": of.slider,
            "tcp_force_scalar": math.hypot(*measured.sensed[:3]),
            "target_q": target.q,
            "target_qd": target.qd,
            "target_qdd": target.qdd,
            "actual_q": measured.q,
            "actual_qd": measured.qd,
            "actual_TCP_pose": measured.pose,
            "actual_TCP_speed": measured.velocity,
            "actual_TCP_force": measured.sensed,
            "target_TCP_pose": six(pose_from_transform(tool)),
            "target_TCP_speed": target_velocity,
            "target_TCP_acceleration": target_acceleration,
            "actual_TCP_acceleration": acceleration,
            "elbow_position": elbow,
            "elbow_velocity": elbow_velocity,
            "control_step": of.cycles,
            "tcp_offset": robot.arm.tcp_offset,
            "ft_raw_wrench": robot.sensing.raw(
                robot.arm.flange_turn(measured.tool),
                robot.arm.lever(measured.tool),
                # `set_gravity` takes what pushes the base up.
                np.array(of.setup.gravity) * -of.setup.payload_kg,
                of.setup.payload_cog,
            ),
            "payload": of.setup.payload_kg,
            "payload_cog": of.setup.payload_cog,
            "payload_inertia": of.setup.payload_inertia,
            "actual_digital_output_bits": of.digital.bits,
            "standard_analog_output0": of.digital.analog[0],
            "standard_analog_output1": of.digital.analog[1],
            "robot_mode": int(safety.robot_mode),
            "safety_mode": int(safety.mode),
            "safety_status": int(safety.mode),
            "runtime_state": int(of.runtime),
            "robot_status_bits": robot_status_bits(
                powered=of.is_powered, playing=playing, freedrive=of.setup.freedrive
            ),
            "safety_status_bits": safety_status_bits(safety.mode),
            "joint_mode": (JOINT_MODES.get(safety.robot_mode, JOINT_POWER_OFF),) * 6,
        }
        outputs.update((name, value) for name, value in values.items() if name in outputs)
        changed, of.inputs.changed = of.inputs.changed, set()
        outputs.update((name, of.inputs.values[name]) for name in changed if name in outputs)
