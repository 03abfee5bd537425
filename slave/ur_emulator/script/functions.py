"""Functions of URScript that move the arm or query its state."""

import math
from collections.abc import Callable
from typing import Final

from haptether.slave.ur_emulator.robot.kinematics import Joints, Six
from haptether.slave.ur_emulator.robot.motions import (
    Motion,
    Move,
    Servo,
    SpeedJoints,
    SpeedTool,
    StopJoints,
    StopTool,
)
from haptether.slave.ur_emulator.robot.robot import Robot
from haptether.slave.ur_emulator.script.program import Program, ScriptError, Steps

LOOKAHEAD_S: Final = (0.03, 0.2)
GAIN: Final = (100.0, 2000.0)
CONTACT_N: Final = 5.0
"""Force in N against the direction at which tool_contact detects a contact."""
CONTACT_BEGINS_N: Final = 1.0
"""Force in N at which the contact began."""


class ScriptFunctions:
    """Functions for the threads of a program; a generator blocks until its function returns.

    Args:
        robot: The arm.
        program: The program with the calling threads.
        jump: Angle in rad by which a target of servoj may change at once.
        protective_stop: Called with the reason if it changes by more.
    """

    def __init__(self, robot: Robot, program: Program, jump: float, protective_stop: Callable[[str], None]) -> None:
        self._jump = jump
        self._protective_stop = protective_stop
        self.robot = robot
        self.program = program
        self.arm = robot.arm

    # ------------------------------------------------------------------------------------------------- motions

    def movej(self, q: Joints, acceleration: float, speed: float) -> Steps:
        """Move in joint space to q in rad."""
        self._check_joints("movej", q)
        return self._until_done(Move(q, _positive("movej", "v", speed), _positive("movej", "a", acceleration)))

    def movel(self, pose: Six, acceleration: float, speed: float) -> Steps:
        """Move the tool straight to a pose."""
        speed, acceleration = _positive("movel", "v", speed), _positive("movel", "a", acceleration)
        return self._until_done(Move(pose, speed, acceleration, self.arm))

    def stopj(self, deceleration: float) -> Steps:
        """Stop in joint space."""
        return self._until_done(StopJoints(_positive("stopj", "a", deceleration)))

    def stopl(self, deceleration: float) -> Steps:
        """Stop along the path of the tool."""
        return self._until_done(StopTool(self.arm, _positive("stopl", "a", deceleration)))

    def servoj(self, q: Joints, time_s: float, lookahead_s: float, gain: float) -> Steps:
        """Follow a joint target for a time."""
        self._check_joints("servoj", q)
        if not LOOKAHEAD_S[0] <= lookahead_s <= LOOKAHEAD_S[1] or not GAIN[0] <= gain <= GAIN[1]:
            message = (
                f"servoj: lookahead_time = {lookahead_s:g}, gain = {gain:g}: must be between {LOOKAHEAD_S[0]:g} and "
                f"{LOOKAHEAD_S[1]:g} s, between {GAIN[0]:g} and {GAIN[1]:g}"
            )
            raise ScriptError(message)
        before = self.robot.motion
        last = before.goal if isinstance(before, Servo) else self.robot.target.q
        if max(abs(new - old) for new, old in zip(q, last, strict=True)) > self._jump:
            self._protective_stop("C204 path sanity check: sudden change in target position")
        self.begin(Servo(q, lookahead_s, gain, tuple(self.robot.model.max_speed)))
        yield from self.sleep(time_s)

    def speedj(self, qd: Joints, acceleration: float, time_s: float) -> Steps:
        """Move at joint velocities for a time; 0 means until they are reached."""
        yield from self._speeding(SpeedJoints(qd, _positive("speedj", "a", acceleration)), time_s)

    def speedl(self, velocity: Six, acceleration: float, time_s: float) -> Steps:
        """Move the tool at a velocity for a time; 0 means until it is reached."""
        motion = SpeedTool(self.arm, velocity, _positive("speedl", "a", acceleration))
        before = self.robot.motion
        if isinstance(before, SpeedTool):
            # Continue from the exact velocity; the joints have it only approximately.
            motion.now = before.now
        yield from self._speeding(motion, time_s)

    def sleep(self, time_s: float) -> Steps:
        """Wait for a time, at least until the next control cycle."""
        for _ in range(max(1, round(time_s / self.robot.period_s))):
            yield

    def _speeding(self, motion: SpeedJoints | SpeedTool, time_s: float) -> Steps:
        self.begin(motion)
        if time_s > 0.0:
            yield from self.sleep(time_s)
            return
        yield
        while not motion.done:
            yield

    def _until_done(self, motion: Motion) -> Steps:
        self.begin(motion)
        yield
        while not motion.done:
            yield
        if self.program.running is not None:
            self.robot.release(self.program.running)

    def begin(self, motion: Motion) -> None:
        """Begin a motion on behalf of the running thread.

        Raises:
            ScriptError: Another thread moves the arm.
        """
        if self.program.running is None:
            raise AssertionError
        self.robot.begin(motion, self.program.running)

    def _check_joints(self, name: str, q: Joints) -> None:
        if not self.arm.is_within_limits(q):
            message = f"{name}: {list(q)} is beyond the limits of the joints"
            raise ScriptError(message)

    # ----------------------------------------------------------------------------------------------- queries

    def inverse(self, pose: Six, near: Joints | None = None) -> Joints:
        """Return joint angles in rad nearest to others, by default those of the arm (get_inverse_kin).

        Raises:
            ScriptError: The pose is out of reach.
        """
        q = self.arm.inverse(pose, near or self.robot.measured.q)
        if q is None or not self.arm.is_within_limits(q):
            message = f"get_inverse_kin: no solution for {[round(v, 6) for v in pose]}"
            raise ScriptError(message)
        return q

    def has_inverse(self, pose: Six, near: Joints | None = None) -> bool:
        """Return True if get_inverse_kin has a solution (get_inverse_kin_has_solution)."""
        q = self.arm.inverse(pose, near or self.robot.measured.q)
        return q is not None and self.arm.is_within_limits(q)

    def tool_contact(self, direction: Six) -> int:
        """Return the control cycles for which the tool has been in contact; 0 without contact (tool_contact).

        The direction is that of the tool, in the base frame; the zero vector stands for every direction.
        """
        length = math.hypot(*direction[:3])

        def against(force: Six) -> float:
            if length == 0.0:
                return math.hypot(*force[:3])
            return -sum(f * d for f, d in zip(force[:3], direction[:3], strict=True)) / length

        history = self.robot.history
        if against(history[-1][1]) < CONTACT_N:
            return 0
        steps = 0
        for _, force in reversed(history):
            if against(force) < CONTACT_BEGINS_N:
                break
            steps += 1
        return max(1, steps)

    def positions_before(self, steps: int) -> Joints:
        """Return the joint angles of `steps` control cycles ago (get_actual_joint_positions_history).

        Raises:
            ScriptError: The time is before the history.
        """
        history = self.robot.history
        if not 0 <= steps < len(history):
            message = f"get_actual_joint_positions_history: steps = {steps}: must be between 0 and {len(history) - 1}"
            raise ScriptError(message)
        return history[-1 - steps][0]


def _positive(name: str, argument: str, value: float) -> float:
    if not 0.0 < value < math.inf:
        message = f"{name}: {argument} = {value:g}: must be positive and finite"
        raise ScriptError(message)
    return value
