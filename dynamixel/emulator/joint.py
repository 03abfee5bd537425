"""Output of an emulated servo: one inertia with friction, and simplified servo loops."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

from haptether.dynamixel.models import OperatingMode, ServoModel

STEP_S: Final = 1e-3
"""Integration step in s; semi-implicit Euler, stable for the loops below."""
MAX_CATCH_UP_S: Final = 0.5
"""Longest pause in s that is integrated; the rest is dropped."""
POSITION_BANDWIDTH: Final = 25.0
"""Bandwidth of the position loop in rad/s, critically damped."""
RIGID: Final = 5e5
"""Stiffness of a rigid stop divided by the inertia, in 1/s^2: 1e-3 kg m^2 yields 1e-3 rad at 0.5 N m."""
VELOCITY_BANDWIDTH: Final = 50.0
"""Bandwidth of the velocity loop in 1/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointSettings:
    """Load of a servo. The maker states no values; defaults scale with the stall torque.

    Raises:
        ValueError: A value is not finite or out of range.
    """

    inertia: float
    """J in kg m^2 at the output."""
    viscous: float
    """b in N m s/rad."""
    coulomb: float
    """c in N m."""

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("inertia", self.inertia, self.inertia > 0.0),
            ("viscous", self.viscous, self.viscous >= 0.0),
            ("coulomb", self.coulomb, self.coulomb >= 0.0),
        ):
            if not (math.isfinite(value) and allowed):
                limit = "positive" if name == "inertia" else "0 or more"
                message = f"{name} = {value:g}: must be finite and {limit}"
                raise ValueError(message)

    @classmethod
    def of(cls, model: ServoModel) -> "JointSettings":
        """Return a load suited to a servo of this model."""
        torque = model.recommended.torque_nm
        return cls(inertia=2e-3 * torque, viscous=0.1 * torque / model.no_load_rad_s, coulomb=0.02 * torque)


@dataclass(slots=True, kw_only=True)
class HeldBy:
    """Hand at an output: K (q_h - q) - D w, with q_h along a minimum-jerk path or a given path.

    Source: T. Flash, N. Hogan, J. Neuroscience 5(7), 1985, minimum jerk: s = 10 r^3 - 15 r^4 + 6 r^5.
    """

    goal_rad: float
    stiffness: float
    """K in N m/rad."""
    damping: float
    """D in N m s/rad."""
    from_rad: float = 0.0
    begin_s: float = 0.0
    duration_s: float = 0.0
    path: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Times in s from the start, and angles in rad; linear in between, at rest after the last."""

    def place_rad(self, now_s: float) -> float:
        """Return q_h at a time."""
        if self.path is not None:
            times, places = self.path
            at_s = now_s - self.begin_s
            index = bisect_right(times, at_s)
            if index == 0 or index == len(times):
                return places[max(index - 1, 0)]
            share = (at_s - times[index - 1]) / (times[index] - times[index - 1])
            return places[index - 1] + share * (places[index] - places[index - 1])
        if self.duration_s <= 0.0 or now_s >= self.begin_s + self.duration_s:
            return self.goal_rad
        r = max(0.0, now_s - self.begin_s) / self.duration_s
        return self.from_rad + (self.goal_rad - self.from_rad) * r**3 * (10.0 + r * (6.0 * r - 15.0))


class Joint:
    """Angle q and velocity w of the output: J dw/dt = n K_t i - b w - c sign(w) + torque of load, hand and push.

    Args:
        model: Model of the servo.
        settings: Load.
        position_rad: Initial q, from the mechanical centre.
        motors: n, number of servos that turn it together.
    """

    def __init__(self, model: ServoModel, settings: JointSettings, position_rad: float = 0.0, motors: int = 1) -> None:
        self.settings = settings
        self.motors = motors
        self.position_rad = position_rad
        self.velocity_rad_s = 0.0
        self.torque_nm = 0.0
        """Motor torque at the output in N m."""
        self.pushed_nm = 0.0
        """External torque in N m."""
        self.load_nm = 0.0
        """Load torque in N m."""
        self.stops: tuple[float, float] | None = None
        """Angles in rad of the end stops."""
        self.rigid = RIGID * settings.inertia
        """Stiffness of a rigid end stop in N m/rad."""
        self.stop_stiffness = self.rigid
        """K of the end stops in N m/rad."""
        self.stop_damping: float | None = None
        """D of the end stops in N m s/rad; None for a damping ratio of 0.7 with J."""
        self.stop_nm = 0.0
        """Torque of the end stops in the last step in N m."""
        self.hand: HeldBy | None = None
        self.hand_nm = 0.0
        """Hand torque in the last step in N m."""
        self.constant_nm_per_a = model.nominal_nm_per_a
        """True K_t of this servo, which may differ from the clients' value."""
        self._stall_nm = model.recommended.torque_nm
        self._no_load_rad_s = model.no_load_rad_s
        self._time_s: float | None = None
        self._reference_rad: float | None = None
        """Current setpoint of a velocity profile."""

    @property
    def current_a(self) -> float:
        """Motor current: i = torque / K_t."""
        return self.torque_nm / self.constant_nm_per_a

    @property
    def load(self) -> float:
        """Torque divided by stall torque, -1 to 1."""
        return self.torque_nm / self._stall_nm

    def advance(self, now_s: float, drive: "Drive | None") -> None:
        """Integrate up to a time; without a drive the output moves freely."""
        if self._time_s is None or now_s - self._time_s > MAX_CATCH_UP_S:
            self._time_s = now_s if self._time_s is None else now_s - MAX_CATCH_UP_S
        while self._time_s + STEP_S <= now_s:
            self._time_s += STEP_S
            self._step(drive)

    def _step(self, drive: "Drive | None") -> None:
        J, b, c = self.settings.inertia, self.settings.viscous, self.settings.coulomb
        if drive is None:
            self.torque_nm, self._reference_rad = 0.0, None
        else:
            self.torque_nm = self._motor(drive)
        torque = self.motors * self.torque_nm + self.pushed_nm + self.load_nm
        before = self.velocity_rad_s
        hand, stretched = self.hand, 0.0
        if hand is not None:
            # Uses the next angle (implicit), hence stable for any stiffness.
            stretched = (hand.place_rad(self._time_s or 0.0) - self.position_rad) * hand.stiffness
            torque += stretched
            b += hand.damping + STEP_S * hand.stiffness
        deep, braked = 0.0 if self.stops is None else self._deep(self.stops), 0.0
        if deep != 0.0:
            K, D = self.stop_stiffness, self.stop_damping
            torque -= K * deep
            braked = (math.sqrt(2.0 * J * K) if D is None else D) + STEP_S * K
            b += braked
        w = before + STEP_S / J * torque
        # J (w' - w) / dt = torque - b w' - c sign(w'): dry friction brakes at most to standstill.
        self.velocity_rad_s = math.copysign(max(abs(w) - STEP_S / J * c, 0.0) / (1.0 + STEP_S * b / J), w)
        self.hand_nm = 0.0
        if hand is not None:
            self.hand_nm = stretched - (hand.damping + STEP_S * hand.stiffness) * self.velocity_rad_s
        self.stop_nm = -self.stop_stiffness * deep - braked * self.velocity_rad_s
        self.position_rad += STEP_S * self.velocity_rad_s

    def _deep(self, stops: tuple[float, float]) -> float:
        """Return the signed penetration into an end stop; 0 between the stops."""
        low, high = stops
        return max(self.position_rad - high, 0.0) + min(self.position_rad - low, 0.0)

    def _towards(self, drive: "Drive") -> float:
        """Return the goal, or the setpoint of a constant-speed profile towards it."""
        if drive.speed_rad_s == math.inf:
            self._reference_rad = None
            return drive.goal
        at = self.position_rad if self._reference_rad is None else self._reference_rad
        step = STEP_S * drive.speed_rad_s
        self._reference_rad = at + min(max(drive.goal - at, -step), step)
        return self._reference_rad

    def _motor(self, drive: "Drive") -> float:
        J, w = self.settings.inertia, self.velocity_rad_s
        limit = min(drive.limit_a * self.constant_nm_per_a, self._stall_nm)
        if drive.mode == OperatingMode.CURRENT:
            wanted = drive.goal * self.constant_nm_per_a
        elif drive.mode == OperatingMode.VELOCITY:
            wanted = J * VELOCITY_BANDWIDTH * (drive.goal - w) + self._friction(drive.goal)
        elif drive.mode == OperatingMode.PWM:
            wanted = drive.goal * self._stall_nm - self._stall_nm * w / self._no_load_rad_s
        else:
            error = self._towards(drive) - self.position_rad
            wanted = J * (POSITION_BANDWIDTH**2 * error - 2.0 * POSITION_BANDWIDTH * w) + self._friction(error)
        # Supply voltage minus the voltage induced by the motor.
        ahead = max(self._stall_nm * (1.0 - max(w, 0.0) / self._no_load_rad_s), 0.0)
        behind = max(self._stall_nm * (1.0 - max(-w, 0.0) / self._no_load_rad_s), 0.0)
        return min(max(wanted, -limit, -behind), limit, ahead)

    def _friction(self, direction: float) -> float:
        # Replaces the integral part of a real loop.
        return math.copysign(self.settings.coulomb, direction) if abs(direction) > 1e-3 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """Command of a servo with torque on.

    Args:
        mode: Operating mode.
        goal: Goal in A, rad/s, rad or as a fraction of the supply, depending on the mode.
        limit_a: Current limit.
        speed_rad_s: Profile speed of a position goal.
    """

    mode: OperatingMode
    goal: float
    limit_a: float
    speed_rad_s: float = math.inf
