"""What the controller can be doing with its joint target; each is asked once a control cycle where that is next."""

import math
from dataclasses import dataclass, field
from typing import Protocol

from haptether.slave.ur_emulator.joint_tracking import Joints, servo_step
from haptether.slave.ur_emulator.pose_paths import PosePath
from haptether.slave.ur_emulator.robot.kinematics import ArmKinematics, Six
from haptether.slave.ur_emulator.script_error import ScriptError
from haptether.slave.ur_emulator.trajectory import Trapezoid

AT_REST = 1e-9
"""Joint speed in rad/s of a target that rests."""
BRAKING = 4.0
"""rad/s² at which the joints stop before the tool begins a line of its own."""


@dataclass(frozen=True, slots=True)
class Target:
    """Where the controller wants the joints: rad, rad/s, rad/s²."""

    q: Joints
    qd: Joints = (0.0,) * 6
    qdd: Joints = (0.0,) * 6

    @property
    def rests(self) -> bool:
        """Whether it does not move."""
        return max(map(abs, self.qd)) < AT_REST


class Motion(Protocol):
    """One way of moving."""

    done: bool
    """Whether the command that began it returns."""

    def step(self, target: Target, step_s: float, share: float) -> Target:
        """The target after a step in s; the controller's own moves go at a share of their speed."""


def towards(target: Target, qd: Joints, acceleration: float, step_s: float) -> tuple[Target, bool]:
    """Joint velocities changed at `acceleration` on the leading joint: the target after the step, and whether reached.

    The position follows by the trapezoidal rule, which is exact for a constant acceleration.
    """
    gap = [wanted - now for wanted, now in zip(qd, target.qd, strict=True)]
    largest = max(map(abs, gap))
    most = acceleration * step_s
    reached = largest <= most
    new = qd if reached else tuple(now + d * most / largest for now, d in zip(target.qd, gap, strict=True))
    return moved(target, new, step_s), reached


def ahead(target: Target, step_s: float) -> Joints:
    """Where the joints will be after a step, to its first order: where velocities at its end are looked for."""
    return tuple(at + rate * step_s for at, rate in zip(target.q, target.qd, strict=True))


def moved(target: Target, qd: Joints, step_s: float) -> Target:
    """The target after a step over which its velocity changes linearly."""
    q = tuple(at + 0.5 * (old + new) * step_s for at, old, new in zip(target.q, target.qd, qd, strict=True))
    qdd = tuple((new - old) / step_s for new, old in zip(qd, target.qd, strict=True))
    return Target(q, qd, qdd)


@dataclass(slots=True)
class StopJoints:
    """Stopj: brakes the joints at a deceleration in rad/s² of the leading one, in step."""

    deceleration: float
    done: bool = False

    def step(self, target: Target, step_s: float, share: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        new, self.done = towards(target, (0.0,) * 6, self.deceleration, step_s)
        return new


@dataclass(slots=True)
class StopTool:
    """Stopl: brakes the tool at a deceleration in m/s² on the way that it goes; rad/s² where it only turns."""

    arm: ArmKinematics
    deceleration: float
    done: bool = False
    _velocity: Six | None = None

    def step(self, target: Target, step_s: float, share: float) -> Target:
        """See `Motion`."""
        velocity = self._velocity or self.arm.tool_velocity(target.q, target.qd)
        speed = max(math.hypot(*velocity[:3]), math.hypot(*velocity[3:]))
        left = speed - self.deceleration * step_s
        if left > 0.0:
            self._velocity = tuple(v * left / speed for v in velocity)
            qd = self.arm.joint_velocity(ahead(target, step_s), self._velocity)
            if qd is not None:
                return moved(target, qd, step_s)
        # At rest, but for what the joints do that the tool does not show; or where the tool cannot be led.
        self._velocity = (0.0,) * 6
        stop = StopJoints(self.deceleration)
        new = stop.step(target, step_s, share)
        self.done = stop.done
        return new


@dataclass(slots=True)
class Servo:
    """Servoj: follows a joint target by a second-order law."""

    goal: Joints
    lookahead_s: float
    gain: float
    max_speed: Joints
    done: bool = True

    def step(self, target: Target, step_s: float, share: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        q, qd, qdd = servo_step(
            target.q,
            target.qd,
            self.goal,
            lookahead_s=self.lookahead_s,
            gain=self.gain,
            max_speed=self.max_speed,
            step_s=step_s,
        )
        return Target(q, qd, qdd)


@dataclass(slots=True)
class SpeedJoints:
    """Speedj: joint velocities in rad/s, reached at an acceleration in rad/s² and kept."""

    qd: Joints
    acceleration: float
    done: bool = False

    def step(self, target: Target, step_s: float, share: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        new, self.done = towards(target, self.qd, self.acceleration, step_s)
        return new


@dataclass(slots=True)
class SpeedTool:
    """Speedl: velocity of the tool in m/s and rad/s, reached at an acceleration in m/s² and kept."""

    arm: ArmKinematics
    velocity: Six
    acceleration: float
    done: bool = False
    now: Six | None = None
    """The velocity that it has come to; that of the joints, when it begins."""

    def step(self, target: Target, step_s: float, share: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        now = self.now or self.arm.tool_velocity(target.q, target.qd)
        most = self.acceleration * step_s
        gap = [wanted - v for wanted, v in zip(self.velocity, now, strict=True)]
        largest = max(math.hypot(*gap[:3]), math.hypot(*gap[3:]))
        self.done = largest <= most
        self.now = self.velocity if self.done else tuple(v + d * most / largest for v, d in zip(now, gap, strict=True))
        qd = self.arm.joint_velocity(ahead(target, step_s), self.now)
        if qd is None:
            message = "speedl: the arm is singular, no joint velocities move the tool so"
            raise ScriptError(message)
        return moved(target, qd, step_s)


@dataclass(slots=True)
class MoveJoints:
    """Movej: straight in joint space from rest to rest, the leading joint at a speed in rad/s; brakes first."""

    goal: Joints
    speed: float
    acceleration: float
    done: bool = False
    _from: Target | None = None
    _profile: Trapezoid = field(default=Trapezoid(0.0, 1.0, 1.0))
    _time_s: float = 0.0

    def step(self, target: Target, step_s: float, share: float) -> Target:
        """See `Motion`."""
        if self._from is None:
            if not target.rests:
                return towards(target, (0.0,) * 6, self.acceleration, step_s)[0]
            self._from = Target(target.q)
            length = max(abs(goal - start) for goal, start in zip(self.goal, target.q, strict=True))
            self._profile = Trapezoid(length, self.speed, self.acceleration)
        self._time_s += share * step_s
        self.done = self._time_s >= self._profile.duration_s
        if self.done:
            return Target(self.goal)
        at = self._profile.at(self._time_s) / self._profile.length
        q = tuple(start + at * (goal - start) for start, goal in zip(self._from.q, self.goal, strict=True))
        return placed(target, q, step_s)


@dataclass(slots=True)
class MoveTool:
    """Movel: the tool on a straight line, turning about one axis, from rest to rest; brakes first."""

    arm: ArmKinematics
    goal: Six
    speed: float
    acceleration: float
    done: bool = False
    _path: PosePath | None = None
    _profile: Trapezoid = field(default=Trapezoid(0.0, 1.0, 1.0))
    _time_s: float = 0.0

    def step(self, target: Target, step_s: float, share: float) -> Target:
        """See `Motion`."""
        if self._path is None:
            if not target.rests:
                return towards(target, (0.0,) * 6, BRAKING, step_s)[0]
            self._path = PosePath(self.arm.pose(target.q), self.goal)
            self._profile = Trapezoid(self._path.length, self.speed, self.acceleration)
        self._time_s += share * step_s
        self.done = self._time_s >= self._profile.duration_s
        at = self._profile.at(self._time_s) / self._profile.length if self._profile.length > 0.0 else 1.0
        pose = self.goal if self.done else self._path.at(at)
        q = self.arm.inverse(pose, target.q)
        if q is None:
            message = "movel: no joint angles for a pose on the way"
            raise ScriptError(message)
        return Target(q) if self.done else placed(target, q, step_s)


@dataclass(slots=True)
class Torque:
    """Direct_torque: `I q'' = tau + tau_external - b q'` on every joint, gravity being compensated."""

    torque: Joints
    inertia: Joints
    friction: Joints
    external: Joints = (0.0,) * 6
    done: bool = True

    def step(self, target: Target, step_s: float, share: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        qd = []
        for rate, tau, pull, inertia, b in zip(
            target.qd, self.torque, self.external, self.inertia, self.friction, strict=True
        ):
            rest = (tau + pull) / b
            qd.append(rest + (rate - rest) * math.exp(-b * step_s / inertia))
        return moved(target, tuple(qd), step_s)


def placed(target: Target, q: Joints, step_s: float) -> Target:
    """The target at q after a step, its velocity being the mean one."""
    qd = tuple((new - old) / step_s for new, old in zip(q, target.q, strict=True))
    qdd = tuple((new - old) / step_s for new, old in zip(qd, target.qd, strict=True))
    return Target(q, qd, qdd)
