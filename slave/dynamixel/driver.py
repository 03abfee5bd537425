"""Driver of an arm of Dynamixel servos as the slave: `device = "dynamixel"`."""

import sys
import time
from typing import Any, Final

import numpy as np

from haptether.dynamixel.arm import ArmSettings, GripServo, ServoArm, Vector
from haptether.printed import printed
from haptether.slave.device import SlaveSample
from haptether.slave.dynamixel.current import CurrentControl
from haptether.slave.dynamixel.options import DynamixelSlaveOptions, dynamixel_slave_options
from haptether.slave.dynamixel.torque import JointTorque

MAX_STEP_S: Final = 0.02
"""Longest step in s of the speed limit after a pause."""
REST_LAG: Final = 0.05
"""Largest offset in rad of a goal from the joint at rest; the offset carries the joint's weight."""


class DynamixelSlave:
    """Servo arm whose joints follow positions, and in mode `current` take torques; see `SlaveDevice`.

    Args:
        options: Fields of `DynamixelSlaveOptions`.

    Raises:
        ValueError: The options are invalid. `open` also raises `ArmRefusedError` if the arm is not ready.
    """

    paces = False
    exerts_by_itself = True
    """The arm holds its joints from `open` on."""
    kinds = ("joints",)

    @property
    def axes(self) -> int:
        """Number of joints."""
        return len(self.settings.servos)

    @property
    def takes_force(self) -> bool:
        """True if `write_force` exerts torques on the joints."""
        return self._control is not None

    @property
    def max_speed(self) -> float:
        """Largest joint speed in rad/s; behind a faster command the arm would continue to move after the release."""
        return self.options.max_speed

    @property
    def max_force(self) -> float | None:
        """Largest torque in N m of `write_force` that every joint can exert; None in a position mode."""
        return None if self._control is None else self._control.max_torque

    @property
    def cycle_s(self) -> float | None:
        """Shortest bus cycle in s, once open."""
        return self.servos.cycle_s

    @property
    def close_s(self) -> float:
        """Time in s for which `close` lowers the arm."""
        return self.servos.close_s

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: DynamixelSlaveOptions = dynamixel_slave_options(options)
        self.settings: ArmSettings = self.options.settings()
        self.servos = ServoArm(self.settings)
        """Servos on their bus."""
        self._torque = JointTorque(
            self.settings.servos,
            constant=self.options.torque_constant,
            coulomb=self.options.coulomb,
            viscous=self.options.viscous,
            filter_hz=self.options.force_filter_hz,
        )
        self._control = CurrentControl(self.options, self.settings) if self.options.mode == "current" else None
        """Control on the host, in current mode."""
        count = len(self.settings.servos)
        self._low: Vector = np.array([servo.low_rad for servo in self.settings.servos])
        self._high: Vector = np.array([servo.high_rad for servo in self.settings.servos])
        self._position: Vector = np.zeros(count)
        self._velocity: Vector = np.zeros(count)
        self._felt: Vector = np.zeros(count)
        self._goal: Vector | None = None
        """Last sent goal; None until the joints are held."""
        self._led = False
        """True if a position was commanded since the last stop."""
        self._forced = False
        """True if the last command was a force."""
        self._is_written = False
        """True if a command came since the last read."""
        self._refused: str | None = None
        """Refused command; the arm holds its joints."""
        self._shown: str | None = None
        self._read_s = self._written_s = 0.0
        self._is_measured = False

    def carry(self, grip: GripServo) -> None:
        """Add a gripper to the bus of its joints, before it is open.

        Raises:
            ValueError: The gripper has the id of a joint.
        """
        self.servos = ServoArm(self.settings, grip=grip)

    def open(self) -> None:
        """Run the checklist; with the first `read` the arm carries its own weight at its position."""
        self._goal, self._refused, self._is_measured = None, None, False
        self._led = self._forced = self._is_written = False
        self.servos.open(give_torque=False)
        self._reset()
        self._read_s = self._written_s = time.monotonic()

    def read(self) -> SlaveSample:
        """Return the latest sample; a failed read is retried until a sample or a fault."""
        arm = self.servos
        if not self._is_measured:
            arm.begin()
            self._is_measured = True
        fresh = arm.read()
        while not fresh and arm.fault is None:
            if self._control is not None:
                # Without a sample nothing bounds a torque, so the joints only carry themselves.
                self.servos.write_currents(self._control.exerting(np.zeros(self.axes)))
            fresh = arm.read()
        now_s = time.monotonic()
        if fresh:
            self._position, self._velocity = arm.position.copy(), arm.velocity.copy()
        if arm.fault is not None:
            self._goal, self._led, self._forced = None, False, False
            # The servos have no torque, so their currents show no force.
            self._felt = np.zeros(len(self._felt))
            self._reset()
        elif fresh:
            period_s = now_s - self._read_s
            if self._control is None:
                self._felt = self._torque.of(arm.current, arm.velocity, period_s)
            else:
                self._felt = self._control.take(arm.plausible.position, arm.velocity, arm.current, period_s)
            if self._goal is None:
                self._goal = self._within(arm.plausible.position)
            if self._control is not None and not self._is_written:
                # A current lasts until the next one, so without a command the host holds the joints.
                self._hold(self.options.max_lag)
            elif self._control is None and arm.ramp < 1.0:
                # The caps rise with each write.
                self._send(self._goal)
        self._read_s, self._is_written = now_s, False
        self._shown = arm.fault or self._refused
        return self._sample()

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:  # noqa: ARG002  # of SlaveDevice
        """Send the joints on, within their limits and speed; no effect during a fault."""
        if self._goal is None or self._refused is not None or self.servos.fault is not None:
            return
        self._end_force()
        now_s = time.monotonic()
        wanted = np.array(position, dtype=float)
        if not np.isfinite(wanted).all():
            self._refuse("an angle was commanded that is no number: see the other side, then acknowledge")
            return
        wanted = self._within(wanted)
        if not self._led:
            away = np.abs(wanted - self.servos.plausible.position)
            if self.options.start == "refuse" and away.max() > self.options.max_jump:
                joint = int(away.argmax())
                self._refuse(
                    f"misaligned start: the first command has joint {joint + 1} {away[joint]:.3f} rad from where it is,"
                    f" beyond max_jump = {self.options.max_jump:g} rad: align both sides, then acknowledge"
                )
                return
            self._led = True
            self._written_s = now_s
        step = self.options.max_speed * min(now_s - self._written_s, MAX_STEP_S)
        self._written_s = now_s
        goal = np.clip(wanted, self._goal - step, self._goal + step)
        at, lag = self.servos.plausible.position, self.options.max_lag
        self._send(self._within(np.clip(goal, at - lag, at + lag)))

    def write_force(self, force: tuple[float, ...], torque: tuple[float, float, float] | None = None) -> None:  # noqa: ARG002  # of a pose
        """Exert torques in N m on the joints until the next command; no effect during a fault.

        Raises:
            ValueError: The mode is not `current`, or the number of torques is wrong.
        """
        if self._control is None:
            message = f"{self.servos.name}: mode = {self.options.mode}: must be current for an arm that takes forces"
            raise ValueError(message)
        wanted = np.array(force, dtype=float)
        if wanted.shape != self._low.shape:
            message = f"{self.servos.name}: {len(force)} torques: must be {self.axes}, one of each joint"
            raise ValueError(message)
        if self._goal is None or self._refused is not None or self.servos.fault is not None:
            return
        if not np.isfinite(wanted).all():
            self._refuse("a torque was commanded that is no number: see the other side, then acknowledge")
            return
        self._led, self._forced, self._is_written = False, True, True
        self.servos.write_currents(self._control.exerting(wanted))

    def stop(self) -> None:
        """Hold the joints in place; keep the goal offset that carries their weight."""
        if self._goal is not None and self.servos.fault is None:
            # In current mode a hold that is pushed away keeps its pull, up to that of the largest lag.
            self._hold(REST_LAG if self._control is None or self._led else self.options.max_lag)
        self._led = False

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault: the checklist runs again, and reports when the arm is ready."""
        if self._shown is None or self._shown != (self.servos.fault or self._refused):
            # A fault since the last sample has not been shown yet.
            return
        self._refused, self._led = None, False
        self.servos.acknowledge(self._shown)

    def close(self) -> None:
        """Lower the arm if its mode allows it, and end all torque."""
        self.servos.close()

    def _end_force(self) -> None:
        """Start the goal where the joints come to rest after a force."""
        if self._forced and self._control is not None:
            self._goal = self._within(self._control.rest())
        self._forced = False

    def _hold(self, lag: float) -> None:
        """Hold the last goal, within a lag in rad of the joints."""
        self._end_force()
        assert self._goal is not None
        at = self.servos.plausible.position
        self._send(self._within(np.clip(self._goal, at - lag, at + lag)))

    def _send(self, goal: Vector) -> None:
        self._goal, self._is_written = goal, True
        if self._control is None:
            self.servos.write_positions(goal)
        else:
            self.servos.write_currents(self._control.holding(goal))

    def _reset(self) -> None:
        self._torque.reset()
        if self._control is not None:
            self._control.reset()

    def _refuse(self, text: str) -> None:
        self.stop()
        self._refused = text
        print(f"{self.servos.name}: fault: {printed(text)}", file=sys.stderr, flush=True)

    def _within(self, angles: Vector) -> Vector:
        return np.clip(angles, self._low, self._high)

    def _sample(self) -> SlaveSample:
        if len(self._position) == 1:
            return SlaveSample(float(self._position[0]), float(self._velocity[0]), float(self._felt[0]), self._shown)
        return SlaveSample(self._position.tolist(), self._velocity.tolist(), self._felt.tolist(), self._shown)
