"""Commands of the control script that neither move the arm nor take time."""

from typing import TYPE_CHECKING

from haptether.slave.ur_emulator.registers import Registers, Six
from haptether.slave.ur_emulator.robot.motions import MoveJoints, MoveTool, Torque
from haptether.slave.ur_emulator.script.functions import ScriptFunctions
from haptether.slave.ur_emulator.script_error import ScriptError
from haptether.slave.ur_emulator.setup import Setup
from haptether.slave.ur_pose import pose_trans

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.slave.ur_emulator.script.program import Steps

MATRIX_REGISTERS = (*range(24), *range(36, 48))
"""Where the 36 numbers of a matrix go, column after column."""


class Answers:
    """Each method reads its arguments from registers and writes its result there."""

    def __init__(self, functions: ScriptFunctions, registers: Registers, setup: Setup) -> None:
        self.do = functions
        self.robot = functions.robot
        self.registers = registers
        self.setup = setup

    def table(self) -> "dict[int, Callable[[], Steps | None]]":
        """By number of the command."""
        registers, force_mode = self.registers, self.robot.force_mode
        return {
            8: self.robot.sensing.zero,
            17: lambda: self.setup.set_payload(registers.double(0), registers.six(1)[:3]),
            18: lambda: self._freedrive(on=True),
            19: lambda: self._freedrive(on=False),
            20: lambda: force_mode.set_damping(registers.double(0)),
            21: self._set_gain_scaling,
            25: lambda: registers.write_integer(1, self.do.tool_contact(registers.six(0))),
            26: lambda: registers.write_double(0, self.robot.period_s),
            27: lambda: registers.write_six(0, self.do.positions_before(registers.integer(1))),
            28: self._target_waypoint,
            29: lambda: self.robot.set_tcp(registers.six(0)),
            30: lambda: registers.write_six(0, self.do.inverse(registers.six(0), registers.six(6))),
            31: lambda: self.setup.protective_stop("protective_stop() of the program"),
            35: lambda: self.setup.set_watchdog(registers.command, registers.double(0)),
            36: lambda: self._tell(yes=self.do.has_inverse(registers.six(0))),
            37: lambda: self._tell(yes=self.do.arm.is_within_limits(registers.six(0))),
            38: lambda: registers.write_six(0, tuple(-torque for torque in self.robot.measured.torque)),
            39: lambda: registers.write_six(0, _plain(pose_trans(registers.six(0), registers.six(6)))),
            40: lambda: registers.write_six(0, self.do.arm.tcp_offset),
            43: lambda: registers.write_six(0, self.robot.measured.pose),
            44: lambda: registers.write_six(0, self.do.arm.pose(registers.six(0), registers.six(6))),
            46: lambda: registers.write_six(0, self.do.inverse(registers.six(0))),
            47: lambda: self._tell(yes=self.robot.is_steady),
            52: lambda: self._freedrive(on=True),
            53: lambda: self._freedrive(on=False),
            54: lambda: registers.write_integer(1, int(self.setup.freedrive)),
            56: self._external_sensor,
            57: self._external_sensor,
            58: lambda: registers.write_six(0, self.do.arm.flange_pose(self.robot.measured.q)),
            59: self._set_gravity,
            60: lambda: self._has_inverse(None),
            61: lambda: self._has_inverse(registers.six(6)),
            65: self._set_target_payload,
            66: self._direct_torque,
            67: lambda: self._dynamics("get_mass_matrix"),
            68: lambda: self._dynamics("get_coriolis_and_centrifugal_torques"),
            69: self._target_acceleration,
            70: self._jacobian,
            71: self._jacobian_rate,
        }

    def _tell(self, *, yes: bool) -> None:
        self.registers.write_integer(1, int(yes))

    def _freedrive(self, *, on: bool) -> None:
        self.setup.freedrive = on
        self.robot.release(on=on)

    def _set_gain_scaling(self) -> None:
        if self.setup.has(None, (5, 0)):
            self.robot.force_mode.set_gain_scaling(self.registers.double(0))

    def _target_waypoint(self) -> None:
        motion = self.robot.motion
        arm = self.do.arm
        if isinstance(motion, MoveTool):
            pose = motion.goal
        elif isinstance(motion, MoveJoints):
            pose = arm.pose(motion.goal)
        else:
            pose = arm.pose(self.robot.target.q)
        self.registers.write_six(0, pose)

    def _external_sensor(self) -> None:
        self.setup.external_sensor = self.registers.integer(1) == 1

    def _set_gravity(self) -> None:
        self.setup.set_gravity(self.registers.six(0)[:3])

    def _has_inverse(self, near: Six | None) -> None:
        if self.setup.has((3, 15), (5, 10)):
            self._tell(yes=self.do.has_inverse(self.registers.six(0), near))

    def _set_target_payload(self) -> None:
        if self.setup.has(None, (5, 10)):
            self.setup.set_payload(self.registers.double(0), self.registers.six(1)[:3])
            self.setup.payload_inertia = self.registers.six(4)

    def _direct_torque(self) -> None:
        if self.setup.has(None, (5, 26)):
            self.do.begin(Torque(self.registers.six(0), self.robot.loop.inertia, self.robot.friction))

    def _dynamics(self, name: str) -> None:
        if self.setup.has(None, (5, 23)):
            message = f"{name}: the emulator has no masses and inertias of the links"
            raise ScriptError(message)

    def _target_acceleration(self) -> None:
        if self.setup.has(None, (5, 23)):
            self.registers.write_six(0, self.robot.target.qdd)

    def _jacobian(self) -> None:
        if self.setup.has(None, (5, 23)):
            _, jacobian = self.do.arm.transform_and_jacobian(self.robot.measured.q)
            self._matrix(jacobian.ravel(order="F").tolist())

    def _jacobian_rate(self) -> None:
        if self.setup.has(None, (5, 23)):
            measured = self.robot.measured
            rate = self.do.arm.jacobian_rate(measured.q, measured.qd)
            self._matrix(rate.ravel(order="F").tolist())

    def _matrix(self, numbers: list[float]) -> None:
        for register, number in zip(MATRIX_REGISTERS, numbers, strict=True):
            self.registers.write_double(register, number)


def _plain(values: object) -> Six:
    return tuple(map(float, values))  # type: ignore[call-overload]  # an array of six
