"""Arm under its controller: the joint target, the joints that follow it, and the tool's environment."""

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from haptether.slave.ur.kinematics.pose import pose_from_transform
from haptether.slave.ur_emulator.robot.contact import ToolEnvironment, WrenchSensing
from haptether.slave.ur_emulator.robot.force_mode import ForceMode
from haptether.slave.ur_emulator.robot.kinematics import ArmKinematics, Array, Joints, Six, six
from haptether.slave.ur_emulator.robot.motions import Motion, StopJoints, Target, Torque, transition
from haptether.slave.ur_emulator.script.program import ScriptError, Thread

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.models import UrModel

MAX_ACCELERATION: Final = 50.0
"""Acceleration in rad/s² of a joint at its largest torque; sets its inertia."""
BANDWIDTH: Final = 2.0 * math.pi * 30.0
"""Bandwidth in rad/s of the loops that hold the joints to their targets."""
IDLE_DECELERATION: Final = 10.0
"""Deceleration in rad/s² of the joint target once nothing commands it."""
FREEDRIVE_LIMITS: Final = (0.25, 0.25, 0.25, 0.5, 0.5, 0.5)
"""Speeds in m/s and rad/s of an arm that is pushed by hand."""
FRICTION_SHARE: Final = 0.05
"""Friction torque of a joint at its largest speed, as a share of its largest torque."""
NO_TORQUE: Final = (0.0,) * 6
MAX_TOOL_M: Final = 10.0
MAX_TARGET_SPEED: Final = 3.0
"""Share of a joint's largest speed: a faster target ends the program, the safety system handles a slower one."""
HISTORY: Final = 2000
"""Number of control cycles with stored joint positions."""


@dataclass(slots=True)
class Measured:
    """Measurements of a control cycle."""

    q: Joints
    qd: Joints
    tool: Array
    """base_from_tool, (4, 4)."""
    pose: Six
    velocity: Six
    """Tool velocity in the base frame, in m/s and rad/s."""
    force: Six
    """True wrench on the tool at its point, in the base frame, in N and N m."""
    sensed: Six
    """Wrench from the sensor, minus its offset."""
    torque: Joints
    """External torque on each joint in N m."""


class Robot:
    """State machine without a clock: `step` advances it by one control cycle.

    Args:
        model: The arm.
        q: Initial joint angles in rad.
        tcp: Its tool in the flange frame, in m and rad.
        period_s: Duration of a control cycle in s.
        touch: Environment of the tool.
        sensing: Its force sensor.
    """

    def __init__(
        self,
        model: "UrModel",
        q: Joints,
        tcp: Six,
        period_s: float,
        *,
        touch: ToolEnvironment | None = None,
        sensing: WrenchSensing | None = None,
    ) -> None:
        self.model = model
        self.period_s = period_s
        self.arm = ArmKinematics(model)
        self.arm.set_tcp(tcp)
        self.touch = touch or ToolEnvironment()
        self.sensing = sensing or WrenchSensing()
        self.loop = JointLoop(
            tuple(torque / MAX_ACCELERATION for torque in model.max_torque), tuple(model.max_torque), BANDWIDTH
        )
        self.target = Target(q)
        self._plan = self.target
        """Target from which the program's motions continue: without the velocity that force mode adds."""
        self.force_mode = ForceMode()
        self.friction: Joints = tuple(
            FRICTION_SHARE * torque / speed for torque, speed in zip(model.max_torque, model.max_speed, strict=True)
        )
        """Viscous friction of each joint in N m s/rad; acts under direct torque only."""
        self._time_s = 0.0
        self.speed_scaling = 1.0
        """Speed share of the controller's own moves: the speed slider, and the reduction by the tool speed limit."""
        self.tool_speed = 0.0
        """Tool speed of the target, in m/s."""
        self.motion: Motion | None = None
        self._thread: Thread | None = None
        self.measured = self._measure(0.0)
        self.history: deque[tuple[Joints, Six]] = deque([(q, self.measured.force)], maxlen=HISTORY)

    # ------------------------------------------------------------------------------------------------ commands

    def begin(self, motion: Motion, thread: Thread) -> None:
        """Begin a motion on behalf of a thread; the motion ends with the thread.

        Raises:
            ScriptError: Another thread moves the arm.
        """
        other = self._thread
        if other is not None and other is not thread and other.alive:
            message = "another thread is already controlling the robot"
            raise ScriptError(message)
        self.motion, self._thread = motion, thread

    def release(self, thread: Thread) -> None:
        """End the thread's command of the arm, which comes to rest."""
        if self._thread is thread:
            self.motion, self._thread = None, None

    def set_tcp(self, offset: Six) -> None:
        """Set the tool in the flange frame; contact is then at its point.

        Raises:
            ScriptError: The tool is longer than 10 m.
        """
        if not max(map(abs, offset[:3])) <= MAX_TOOL_M:
            message = f"set_tcp: {list(offset)}: must be within {MAX_TOOL_M:g} m of the flange"
            raise ScriptError(message)
        self.arm.set_tcp(offset)
        self.measured = self._measure(self._time_s)

    def end_force_mode(self) -> None:
        """End force mode; the arm continues at its present velocity."""
        if self.force_mode.active:
            self.force_mode.end()
            self._plan = self.target

    def set_freedrive(self, *, on: bool) -> None:
        """Turn freedrive (teach mode) on or off: a push then moves the arm."""
        if on:
            self.force_mode.begin((0.0,) * 6, (True,) * 6, (0.0,) * 6, 2, FREEDRIVE_LIMITS)
        else:
            self.end_force_mode()

    def brake(self, deceleration: float) -> None:
        """Stop the arm, whatever commands it."""
        self.end_force_mode()
        self.motion, self._thread = StopJoints(deceleration), None

    def reset(self, q: Joints, tcp: Six) -> None:
        """Place the arm at q at once, at rest, with a tool and no other setting."""
        self.target = self._plan = Target(q)
        self.loop.reset()
        self.force_mode.reset()
        self.sensing.offset = (0.0,) * 6
        self.motion, self._thread = None, None
        self.arm.set_tcp(tcp)
        self.measured = self._measure(self._time_s)

    @property
    def is_steady(self) -> bool:
        """Return True if target and joints are at rest."""
        return self.target.at_rest and max(map(abs, self.loop.rate)) < 1e-4

    # ---------------------------------------------------------------------------------------------------- step

    def step(self, time_s: float) -> None:
        """Advance by one control cycle, which ends at a time in s of the environment.

        Raises:
            ScriptError: The motion cannot continue.
        """
        try:
            self.target = self._next_target()
        except (ScriptError, ValueError, ArithmeticError) as error:
            self.brake(IDLE_DECELERATION)
            self.target = self._next_target()
            raise ScriptError(str(error)) from None
        finally:
            self._time_s = time_s
            # Under direct torque the external torque moves the target itself.
            free = isinstance(self.motion, Torque)
            self.loop.step(self.target.qdd, NO_TORQUE if free else self.measured.torque, self.period_s)
            measured = self.measured
            self.touch.advance(time_s - self.period_s, self.period_s, measured.pose[:3], measured.velocity[:3])
            self.measured = self._measure(time_s)
            self.history.append((self.measured.q, self.measured.sensed))

    def _next_target(self) -> Target:
        motion, thread = self.motion, self._thread
        now = self._plan
        if motion is None or (thread is not None and not thread.alive):
            motion = self.motion = None if now.at_rest else StopJoints(IDLE_DECELERATION)
            self._thread = None
        if isinstance(motion, Torque):
            motion.external = self.measured.torque
        plan = Target(now.q) if motion is None else motion.step(now, self.period_s, self.speed_scaling)
        if not self.force_mode.active:
            self._check(plan)
            self._plan = plan
            return plan
        new = self._compliant(self.target, plan)
        self._check(new)
        self._plan = Target(new.q, plan.qd, plan.qdd)
        return new

    def _check(self, target: Target) -> None:
        for joint, (rate, max_speed) in enumerate(zip(target.qd, self.model.max_speed, strict=True), start=1):
            # In this form NaN fails too.
            if not abs(rate) <= MAX_TARGET_SPEED * max_speed:
                message = f"the target of joint {joint} would move at {rate:.3g} rad/s"
                raise ScriptError(message)

    def _compliant(self, now: Target, new: Target) -> Target:
        _, jacobian = self.arm.transform_and_jacobian(now.q)
        # The mean speed of the step, not that at its end, keeps the positions of program and target together.
        mean = [(b - a) / self.period_s for a, b in zip(now.q, new.q, strict=True)]
        velocity = self.force_mode.velocity(
            jacobian @ np.array(mean),
            self.measured.sensed,
            self.measured.tool,
            np.array(self.measured.velocity),
            self.period_s,
        )
        qd = self.arm.joint_velocity(now.q, six(velocity))
        if qd is None:
            message = "force_mode: the arm is singular"
            raise ScriptError(message)
        q = tuple(a + v * self.period_s for a, v in zip(now.q, qd, strict=True))
        qdd = tuple((v - old) / self.period_s for v, old in zip(qd, now.qd, strict=True))
        return Target(q, qd, qdd)

    def _measure(self, time_s: float) -> Measured:
        q = tuple(a + d for a, d in zip(self.target.q, self.loop.deflection, strict=True))
        qd = tuple(a + d for a, d in zip(self.target.qd, self.loop.rate, strict=True))
        tool, jacobian = self.arm.transform_and_jacobian(q)
        # The kinematics reuse their memory in the next call.
        velocity = six(jacobian @ np.array(qd))
        pose = six(pose_from_transform(tool))
        touch = self.touch
        force = (*touch.force(time_s, pose[:3], velocity[:3]), *touch.moment(tool[:3, :3], velocity[3:]))
        torque = six(jacobian.T @ np.array(force))
        return Measured(q, qd, tool, pose, velocity, force, self.sensing.sample(force), torque)


@dataclass(slots=True)
class JointLoop:
    """Joints as they follow their target: stiff, critically damped, with motors that saturate.

    With `delta = q - q_target` the loop is `delta'' = u - q_target'' + tau / I`. The motor supplies
    `u = q_target'' - w² delta - 2 w delta'` within `|I u| <= tau_max`. A joint with enough torque follows exactly and
    yields to an external torque by `tau / (I w²)`.

    Args:
        inertia: I of each joint in kg m².
        max_torque: `tau_max` in N m.
        bandwidth: w in rad/s.
    """

    inertia: Joints
    max_torque: Joints
    bandwidth: float
    deflection: Joints = (0.0,) * 6
    rate: Joints = (0.0,) * 6
    saturated: bool = False
    """True if a motor had too little torque in the last step."""

    def step(self, target_qdd: Joints, torque: Joints, step_s: float) -> None:
        """Advance by a step in s under a constant external torque in N m."""
        w = self.bandwidth
        a, b, c, d = transition(w * w, 2.0 * w, step_s)
        deflections, rates = [], []
        self.saturated = False
        for delta, rate, inertia, max_torque, qdd, tau in zip(
            self.deflection, self.rate, self.inertia, self.max_torque, target_qdd, torque, strict=True
        ):
            motor = qdd - w * w * delta - 2.0 * w * rate
            limit = max_torque / inertia
            if -limit <= motor <= limit:
                settled = tau / (inertia * w * w)
                deflections.append(settled + a * (delta - settled) + b * rate)
                rates.append(c * (delta - settled) + d * rate)
                continue
            self.saturated = True
            acceleration = math.copysign(limit, motor) - qdd + tau / inertia
            deflections.append(delta + rate * step_s + 0.5 * acceleration * step_s * step_s)
            rates.append(rate + acceleration * step_s)
        self.deflection, self.rate = tuple(deflections), tuple(rates)

    def reset(self) -> None:
        """Put the joints at rest on the target."""
        self.deflection = self.rate = (0.0,) * 6
