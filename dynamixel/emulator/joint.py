"""What turns behind an emulated servo: one inertia with friction, and the servo's loops as simple as they can be."""

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final

from haptether.dynamixel.models import OperatingMode, ServoModel

STEP_S: Final = 1e-3
"""Of the integration; semi-implicit Euler, stable for the loops below."""
MAX_CATCH_UP_S: Final = 0.5
"""Time that is integrated after a pause; more is lost."""
POSITION_BANDWIDTH: Final = 25.0
"""Of the position loop, rad/s, critically damped."""
STOP_STIFFNESS: Final = 5e5
"""Of something rigid, over the inertia, 1/s^2: an output of 1e-3 kg m^2 goes 1e-3 rad into it at 0.5 N m."""
STOP_DAMPING: Final = 1e3
"""Ibid., 1/s."""
VELOCITY_BANDWIDTH: Final = 50.0
"""Of the velocity loop, 1/s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointSettings:
    """The load of a servo. The maker states none of these: the defaults scale with its stall torque.

    Raises:
        ValueError: A number that is not finite or not in its range.
    """

    inertia: float
    """J, kg m^2 at the output."""
    viscous: float
    """b, N m s/rad."""
    coulomb: float
    """c, N m."""

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
        """A load that a servo of this model moves well."""
        torque = model.recommended.torque_nm
        return cls(inertia=2e-3 * torque, viscous=0.1 * torque / model.no_load_rad_s, coulomb=0.02 * torque)


@dataclass(slots=True, kw_only=True)
class HeldBy:
    """A hand at an output: K (q_h - q) - D w, whose q_h goes from one place to another without a jerk.

    Source: T. Flash, N. Hogan, J. Neuroscience 5(7), 1985, minimum jerk: s = 10 r^3 - 15 r^4 + 6 r^5.
    """

    goal_rad: float
    stiffness: float
    """K, N m/rad."""
    damping: float
    """D, N m s/rad."""
    from_rad: float = 0.0
    begin_s: float = 0.0
    duration_s: float = 0.0
    path: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Times in s from the begin, and places in rad; straight between them, and at rest after the last."""

    def place_rad(self, now_s: float) -> float:
        """q_h at a time."""
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
        model: The servo.
        settings: The load.
        position_rad: q at the begin, from the mechanical centre.
        motors: n, servos that turn it together.
    """

    def __init__(self, model: ServoModel, settings: JointSettings, position_rad: float = 0.0, motors: int = 1) -> None:
        self.settings = settings
        self.motors = motors
        self.position_rad = position_rad
        self.velocity_rad_s = 0.0
        self.torque_nm = 0.0
        """Of the motor, at the output."""
        self.pushed_nm = 0.0
        """Of whoever pushes."""
        self.load_nm = 0.0
        """Of what it carries."""
        self.stops: tuple[float, float] | None = None
        """Angles in rad beyond which something rigid stops the output."""
        self.hand: HeldBy | None = None
        self.hand_nm = 0.0
        """Of the hand, in the last step."""
        self.constant_nm_per_a = model.nominal_nm_per_a
        """K_t of this servo, which may be another than its clients take it for."""
        self._stall_nm = model.recommended.torque_nm
        self._no_load_rad_s = model.no_load_rad_s
        self._time_s: float | None = None
        self._reference_rad: float | None = None
        """Where a profile is on its way to the goal."""

    @property
    def current_a(self) -> float:
        """Of the motor: i = torque / K_t."""
        return self.torque_nm / self.constant_nm_per_a

    @property
    def load(self) -> float:
        """Torque over stall torque, -1 to 1."""
        return self.torque_nm / self._stall_nm

    def advance(self, now_s: float, drive: "Drive | None") -> None:
        """Integrates up to a time; without a drive the output runs free."""
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
            # Of where the output will be: stable however stiff the hand is.
            stretched = (hand.place_rad(self._time_s or 0.0) - self.position_rad) * hand.stiffness
            torque += stretched
            b += hand.damping + STEP_S * hand.stiffness
        if self.stops is not None and (deep := self._deep(self.stops)) != 0.0:
            torque -= J * STOP_STIFFNESS * deep
            b += J * (STOP_DAMPING + STEP_S * STOP_STIFFNESS)
        w = before + STEP_S / J * torque
        # J (w' - w) / dt = torque - b w' - c sign(w'): dry friction takes away what it can, down to standing still.
        self.velocity_rad_s = math.copysign(max(abs(w) - STEP_S / J * c, 0.0) / (1.0 + STEP_S * b / J), w)
        self.hand_nm = 0.0
        if hand is not None:
            self.hand_nm = stretched - (hand.damping + STEP_S * hand.stiffness) * self.velocity_rad_s
        self.position_rad += STEP_S * self.velocity_rad_s

    def _deep(self, stops: tuple[float, float]) -> float:
        """How far it is in what stops it, with its sign; 0 between them."""
        low, high = stops
        return max(self.position_rad - high, 0.0) + min(self.position_rad - low, 0.0)

    def _towards(self, drive: "Drive") -> float:
        """The goal, or where a profile of constant speed is on its way there."""
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
        # What the supply leaves over the voltage that the motor induces.
        ahead = max(self._stall_nm * (1.0 - max(w, 0.0) / self._no_load_rad_s), 0.0)
        behind = max(self._stall_nm * (1.0 - max(-w, 0.0) / self._no_load_rad_s), 0.0)
        return min(max(wanted, -limit, -behind), limit, ahead)

    def _friction(self, direction: float) -> float:
        # In place of the integral part of a real loop.
        return math.copysign(self.settings.coulomb, direction) if abs(direction) > 1e-3 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Drive:
    """What a servo with torque on does.

    Args:
        mode: Its operating mode.
        goal: In A, rad/s, rad or a fraction of the supply, by the mode.
        limit_a: Of the current.
        speed_rad_s: Of the profile on which it goes to a position.
    """

    mode: OperatingMode
    goal: float
    limit_a: float
    speed_rad_s: float = math.inf
