"""Motions of the joint target: profiles, paths, the law of servoj. Each control cycle advances a motion by one step."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

from haptether.slave.ur.kinematics.pose import (
    Quaternion,
    quat_product,
    quat_wxyz_from_rotvec,
    rotvec_from_quat_wxyz,
)
from haptether.slave.ur_emulator.robot.kinematics import ArmKinematics, Joints, Six
from haptether.slave.ur_emulator.script.program import ScriptError

AT_REST = 1e-9
"""Joint speed in rad/s below which a target is at rest."""
BRAKING = 4.0
"""Joint deceleration in rad/s² before the tool begins a line."""


@dataclass(frozen=True, slots=True)
class Target:
    """Joint target in rad, rad/s, rad/s²."""

    q: Joints
    qd: Joints = (0.0,) * 6
    qdd: Joints = (0.0,) * 6

    @property
    def at_rest(self) -> bool:
        """Return True if all joint velocities are zero except for rounding."""
        return max(map(abs, self.qd)) < AT_REST


class Motion(Protocol):
    """Source of the joint target."""

    done: bool
    """True once the command that began the motion returns."""

    def step(self, target: Target, step_s: float, scaling: float) -> Target:
        """Return the target after a step in s; `scaling` is the speed share of the controller's own moves."""


# ------------------------------------------------------------------------------------------------------ one step


def ramped(target: Target, qd: Joints, acceleration: float, step_s: float) -> tuple[Target, bool]:
    """Change joint velocities at `acceleration` on the leading joint; return the target after the step, and if reached.

    The position follows by the trapezoidal rule, which is exact for a constant acceleration.
    """
    new, reached = approached(target.qd, qd, acceleration * step_s, lambda gap: max(map(abs, gap)))
    return integrated(target, new, step_s), reached


def approached(now: Six, wanted: Six, max_change: float, size: Callable[[Six], float]) -> tuple[Six, bool]:
    """Change numbers in proportion towards others, by at most `max_change`; return them, and True if reached."""
    gap = tuple(new - old for new, old in zip(wanted, now, strict=True))
    largest = size(gap)
    if largest <= max_change:
        return wanted, True
    return tuple(old + d * max_change / largest for old, d in zip(now, gap, strict=True)), False


def tool_speed(velocity: Six) -> float:
    """Return the speed of a moving and rotating tool, in m/s or rad/s: the larger number."""
    return max(math.hypot(*velocity[:3]), math.hypot(*velocity[3:]))


def predicted(target: Target, step_s: float) -> Joints:
    """Return the joint angles after a step, to first order, for solving the velocities at its end."""
    return tuple(at + rate * step_s for at, rate in zip(target.q, target.qd, strict=True))


def integrated(target: Target, qd: Joints, step_s: float) -> Target:
    """Return the target after a step over which its velocity changes linearly to qd."""
    q = tuple(at + 0.5 * (old + new) * step_s for at, old, new in zip(target.q, target.qd, qd, strict=True))
    qdd = tuple((new - old) / step_s for new, old in zip(qd, target.qd, strict=True))
    return Target(q, qd, qdd)


def differentiated(target: Target, q: Joints, step_s: float) -> Target:
    """Return the target at q after a step, with the mean velocity."""
    qd = tuple((new - old) / step_s for new, old in zip(q, target.q, strict=True))
    qdd = tuple((new - old) / step_s for new, old in zip(qd, target.qd, strict=True))
    return Target(q, qd, qdd)


# --------------------------------------------------------------------------------------------------------- stops


@dataclass(slots=True)
class StopJoints:
    """Stopj: brakes all joints together, with the deceleration in rad/s² of the leading joint."""

    deceleration: float
    done: bool = False

    def step(self, target: Target, step_s: float, scaling: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        new, self.done = ramped(target, (0.0,) * 6, self.deceleration, step_s)
        return new


@dataclass(slots=True)
class StopTool:
    """Stopl: brakes the tool along its path, in m/s² (rad/s² if it only rotates)."""

    arm: ArmKinematics
    deceleration: float
    done: bool = False
    _velocity: Six | None = None

    def step(self, target: Target, step_s: float, scaling: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        velocity = self._velocity or self.arm.tool_velocity(target.q, target.qd)
        speed = tool_speed(velocity)
        left = speed - self.deceleration * step_s
        if left > 0.0:
            self._velocity = tuple(v * left / speed for v in velocity)
            qd = self.arm.joint_velocity(predicted(target, step_s), self._velocity)
            if qd is not None:
                return integrated(target, qd, step_s)
        # At a singularity, or the tool is at rest although joints may move.
        self._velocity = (0.0,) * 6
        new, self.done = ramped(target, (0.0,) * 6, self.deceleration, step_s)
        return new


# -------------------------------------------------------------------------------------------------- servo, speed


@dataclass(slots=True)
class Servo:
    """Servoj: follows a joint target by a second-order law, exact for a constant target.

    The law is `q'' = gain (q_target - q - lookahead q')`. The lag behind a target at speed v is thus `lookahead v`.
    The natural frequency is `sqrt(gain)` rad/s, the damping ratio `lookahead sqrt(gain) / 2`. Joints keep their speed
    limits.

    Source: second-order model of servoj with the tracking delays that are reported for it (34 ms with a lookahead of
    0.03 s and a gain of 1200 on a UR10e).
    """

    goal: Joints
    lookahead_s: float
    gain: float
    max_speed: Joints
    done: bool = True

    def step(self, target: Target, step_s: float, scaling: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        a, b, c, d = transition(self.gain, self.gain * self.lookahead_s, step_s)
        q, qd = [], []
        for now, rate, goal, limit in zip(target.q, target.qd, self.goal, self.max_speed, strict=True):
            error = now - goal
            speed = c * error + d * rate
            if -limit <= speed <= limit:
                q.append(goal + a * error + b * rate)
            else:
                speed = math.copysign(limit, speed)
                q.append(now + 0.5 * (rate + speed) * step_s)
            qd.append(speed)
        qdd = tuple((new - old) / step_s for new, old in zip(qd, target.qd, strict=True))
        return Target(tuple(q), tuple(qd), qdd)


@lru_cache(maxsize=64)
def transition(stiffness: float, damping: float, step_s: float) -> tuple[float, float, float, float]:
    """Return `e^{A h}` of `e'' = -stiffness e - damping e'`, in closed form, row by row.

    Args:
        stiffness: In 1/s² (> 0).
        damping: In 1/s (>= 0).
        step_s: h in s.

    Source: any text on linear systems; the test compares it with `scipy.linalg.expm`.
    """
    half = 0.5 * damping
    decay = math.exp(-half * step_s)
    inside = half * half - stiffness
    if abs(inside) * step_s * step_s < 1e-12:
        c, s = 1.0, step_s
    elif inside > 0.0:
        root = math.sqrt(inside)
        c, s = math.cosh(root * step_s), math.sinh(root * step_s) / root
    else:
        root = math.sqrt(-inside)
        c, s = math.cos(root * step_s), math.sin(root * step_s) / root
    return decay * (c + half * s), decay * s, -decay * stiffness * s, decay * (c - half * s)


@dataclass(slots=True)
class SpeedJoints:
    """Speedj: reaches joint velocities in rad/s at an acceleration in rad/s² and keeps them."""

    qd: Joints
    acceleration: float
    done: bool = False

    def step(self, target: Target, step_s: float, scaling: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        new, self.done = ramped(target, self.qd, self.acceleration, step_s)
        return new


@dataclass(slots=True)
class SpeedTool:
    """Speedl: reaches a tool velocity in m/s and rad/s at an acceleration in m/s² and keeps it."""

    arm: ArmKinematics
    velocity: Six
    acceleration: float
    done: bool = False
    now: Six | None = None
    """Velocity reached so far; None takes the velocity of the joints."""

    def step(self, target: Target, step_s: float, scaling: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        now = self.now or self.arm.tool_velocity(target.q, target.qd)
        self.now, self.done = approached(now, self.velocity, self.acceleration * step_s, tool_speed)
        qd = self.arm.joint_velocity(predicted(target, step_s), self.now)
        if qd is None:
            message = "speedl: the arm is singular, no joint velocities move the tool so"
            raise ScriptError(message)
        return integrated(target, qd, step_s)


@dataclass(slots=True)
class Torque:
    """Direct_torque: `I q'' = tau + tau_external - b q'` on every joint, with gravity compensated.

    The external torque is that of the old positions, so the new positions follow from the new velocities (symplectic
    Euler): a stiff contact then gains no energy. Their mean would add `K h / (2 m)` of negative damping, in 1/s, to a
    contact of stiffness K on a mass m.

    Source: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2006, section I.1.2.
    """

    torque: Joints
    inertia: Joints
    friction: Joints
    external: Joints = (0.0,) * 6
    done: bool = True

    def step(self, target: Target, step_s: float, scaling: float) -> Target:  # noqa: ARG002
        """See `Motion`."""
        qd = []
        for rate, tau, external, inertia, b in zip(
            target.qd, self.torque, self.external, self.inertia, self.friction, strict=True
        ):
            final = (tau + external) / b
            qd.append(final + (rate - final) * math.exp(-b * step_s / inertia))
        q = tuple(at + rate * step_s for at, rate in zip(target.q, qd, strict=True))
        qdd = tuple((new - old) / step_s for new, old in zip(qd, target.qd, strict=True))
        return Target(q, tuple(qd), qdd)


# --------------------------------------------------------------------------------------------------------- moves


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """Distance along a path from rest to rest in m or rad: speeds up at a, continues at v, slows down at a.

    On a path shorter than `v²/a`, the top speed is `sqrt(a length)`.
    """

    length: float
    speed: float
    acceleration: float

    @property
    def top_speed(self) -> float:
        """Largest speed on the path."""
        return min(self.speed, math.sqrt(self.acceleration * self.length))

    @property
    def rise_s(self) -> float:
        """Time to the top speed, in s."""
        return self.top_speed / self.acceleration

    @property
    def duration_s(self) -> float:
        """Time from rest to rest, in s."""
        return self.rise_s + self.length / self.top_speed if self.length > 0.0 else 0.0

    def at(self, time_s: float) -> float:
        """Distance after a time in s."""
        left = self.duration_s - time_s
        if time_s <= 0.0:
            return 0.0
        if left <= 0.0:
            return self.length
        rise = self.rise_s
        if time_s < rise:
            return 0.5 * self.acceleration * time_s * time_s
        if left < rise:
            return self.length - 0.5 * self.acceleration * left * left
        return self.top_speed * (time_s - 0.5 * rise)


@dataclass(frozen=True, slots=True)
class JointPath:
    """Straight line from one set of joint angles to another."""

    start: Joints
    end: Joints

    @property
    def length(self) -> float:
        """Angle of the leading joint in rad."""
        return max(abs(end - start) for start, end in zip(self.start, self.end, strict=True))

    def at(self, share: float) -> Joints:
        """Return the joint angles at a share of the path, from 0 to 1."""
        return tuple(start + share * (end - start) for start, end in zip(self.start, self.end, strict=True))


@dataclass(slots=True)
class PosePath:
    """Straight line from one pose to another; it rotates about a fixed axis of the first pose's frame."""

    start: Six
    end: Six
    _first: Quaternion = field(init=False)
    _rotation: tuple[float, float, float] = field(init=False)

    def __post_init__(self) -> None:
        w, x, y, z = self._first = quat_wxyz_from_rotvec(self.start[3:])
        self._rotation = rotvec_from_quat_wxyz(quat_product((w, -x, -y, -z), quat_wxyz_from_rotvec(self.end[3:])))

    @property
    def length(self) -> float:
        """Length in m, or angle in rad if that is more."""
        return max(math.dist(self.start[:3], self.end[:3]), math.hypot(*self._rotation))

    def at(self, share: float) -> Six:
        """Return the pose at a share of the path, from 0 to 1."""
        position = tuple(a + share * (b - a) for a, b in zip(self.start[:3], self.end[:3], strict=True))
        rotated = quat_product(self._first, quat_wxyz_from_rotvec([share * angle for angle in self._rotation]))
        return (*position, *rotvec_from_quat_wxyz(rotated))


@dataclass(slots=True)
class Move:
    """Movej and movel: along a straight path from rest to rest; brakes first."""

    goal: Six
    """Joint angles in rad; for movel, the tool pose."""
    speed: float
    """Speed of the leading joint in rad/s; for movel, in m/s, or rad/s if the tool rotates by more."""
    acceleration: float
    arm: ArmKinematics | None = None
    """For movel only."""
    done: bool = False
    _path: JointPath | PosePath | None = None
    _profile: Trapezoid = field(init=False)
    _time_s: float = 0.0

    def step(self, target: Target, step_s: float, scaling: float) -> Target:
        """See `Motion`."""
        arm = self.arm
        if self._path is None:
            if not target.at_rest:
                return ramped(target, (0.0,) * 6, self.acceleration if arm is None else BRAKING, step_s)[0]
            self._path = JointPath(target.q, self.goal) if arm is None else PosePath(arm.pose(target.q), self.goal)
            self._profile = Trapezoid(self._path.length, self.speed, self.acceleration)
        self._time_s += scaling * step_s
        self.done = self._time_s >= self._profile.duration_s
        at = self.goal if self.done else self._path.at(self._profile.at(self._time_s) / self._profile.length)
        q = at if arm is None else arm.inverse(at, target.q)
        if q is None:
            message = "movel: no joint angles for a pose on the way"
            raise ScriptError(message)
        return Target(q) if self.done else differentiated(target, q, step_s)
