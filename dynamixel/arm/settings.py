"""Settings of a servo arm: its bus, and the map from servo to joint angles."""

import math
from dataclasses import dataclass, replace
from typing import Final

from haptether.dynamixel.models import CURRENT_MODES, SERVO_MODELS, OperatingMode, ServoModel

TURN: Final = 2.0 * math.pi
MAX_SERVOS: Final = 32
MAX_ID: Final = 252
MAX_ANGLE: Final = 512.0 * math.pi
"""Limit of the multi-turn modes in rad."""
MAX_CONSTANT: Final = 20.0
"""Largest torque constant in N m/A."""
CAP_SHARE: Final = 0.3
"""Default cap as a fraction of the model's largest current; makers do not state a continuous rating."""
ARM_MODES: Final = frozenset(
    {
        OperatingMode.CURRENT,
        OperatingMode.EXTENDED_POSITION,
        OperatingMode.CURRENT_BASED_POSITION,
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoSettings:
    """Servo and the joint that it turns.

    q = sign (p - offset) + 2 pi k. p is Present Position in rad from the mechanical centre, with the homing offset and
    direction in the servo's EEPROM. k is the turn that puts q within its limits, because a servo loses turns at
    power-off.

    Raises:
        ValueError: A setting is invalid; names it with the id.
    """

    servo_id: int
    model: str
    """Key of `SERVO_MODELS`."""
    sign: int = 1
    """1 or -1."""
    offset_rad: float = 0.0
    """p at q = 0."""
    low_rad: float = -math.pi
    """Smallest q."""
    high_rad: float = math.pi
    """Largest q."""
    near_rad: float | None = None
    """Approximate q at power-on, which selects between two fitting turns; by default the middle of the limits."""
    cap_a: float | None = None
    """Largest current in A; by default 0.3 of the model's largest."""
    torque_constant: float | None = None
    """Measured K_t of this servo in N m/A; by default the published one of its model."""
    torque_constant_uncertainty: float = 0.0
    """Largest error of that K_t in N m/A."""
    mode: OperatingMode = OperatingMode.CURRENT
    shadows: tuple[int, ...] = ()
    """Servos of the same model that turn the same joint and obey this id (address 12 of each)."""

    def __post_init__(self) -> None:
        for servo_id in (self.servo_id, *self.shadows):
            if not 0 <= servo_id <= MAX_ID:
                message = f"id {servo_id}: must be 0 to {MAX_ID}"
                raise ValueError(message)
        if self.model not in SERVO_MODELS:
            self._refuse(f"model = {self.model!r}: must be one of {', '.join(SERVO_MODELS)}")
        if self.sign not in {1, -1}:
            self._refuse(f"sign = {self.sign}: must be 1 or -1")
        for name, value in (
            ("offset_rad", self.offset_rad), ("low_rad", self.low_rad), ("high_rad", self.high_rad),
            ("near_rad", self.middle_rad),
        ):  # fmt: skip
            if not abs(value) <= MAX_ANGLE:
                self._refuse(f"{name} = {value:g}: must be within {MAX_ANGLE:.0f} rad")
        if not self.low_rad < self.high_rad:
            self._refuse(f"low_rad = {self.low_rad:g}: must be below high_rad = {self.high_rad:g}")
        if not self.low_rad <= self.middle_rad <= self.high_rad:
            self._refuse(f"near_rad = {self.middle_rad:g}: must be {self.low_rad:g} to {self.high_rad:g}")
        if self.mode not in ARM_MODES & self.servo.operating_modes:
            allowed = ", ".join(f"{mode.value} ({mode.name.lower()})" for mode in sorted(self._modes))
            self._refuse(f"mode = {int(self.mode)}: a {self.model} must have one of {allowed}")
        if self.torque_constant is not None and not 0.0 < self.torque_constant <= MAX_CONSTANT:
            self._refuse(
                f"torque_constant = {self.torque_constant:g}: must be above 0 and at most {MAX_CONSTANT:g} N m/A"
            )
        if not 0.0 <= self.torque_constant_uncertainty <= (self.torque_constant or 0.0):
            given = f"torque_constant_uncertainty = {self.torque_constant_uncertainty:g}"
            self._refuse(f"{given}: must be 0 to torque_constant")
        most_a = self.servo.max_current_a
        if self.cap_a is not None and (most_a is None or not 0.0 < self.cap_a <= most_a):
            what = "has no current control" if most_a is None else f"must be above 0 and at most {most_a:g} A"
            self._refuse(f"cap_a = {self.cap_a:g}: a {self.model} {what}")

    @property
    def servo(self) -> ServoModel:
        """Model of the servo."""
        return SERVO_MODELS[self.model]

    @property
    def nm_per_a(self) -> float:
        """Likely K_t, which converts a measured current to a torque."""
        return self.servo.nominal_nm_per_a if self.torque_constant is None else self.torque_constant

    @property
    def most_nm_per_a(self) -> float:
        """Largest possible K_t, which converts a commanded torque to a current, so that the torque is not exceeded."""
        if self.torque_constant is None:
            return self.servo.largest_nm_per_a
        return self.torque_constant + self.torque_constant_uncertainty

    @property
    def middle_rad(self) -> float:
        """Approximate q at power-on."""
        return 0.5 * (self.low_rad + self.high_rad) if self.near_rad is None else self.near_rad

    @property
    def current_cap_a(self) -> float:
        """Largest current in A; 0 without current control."""
        return CAP_SHARE * (self.servo.max_current_a or 0.0) if self.cap_a is None else self.cap_a

    @property
    def limits_current(self) -> bool:
        """True if its mode limits the current to Goal Current."""
        return self.mode in CURRENT_MODES

    @property
    def _modes(self) -> frozenset[OperatingMode]:
        return ARM_MODES & self.servo.operating_modes

    def _refuse(self, what: str) -> None:
        message = f"servo {self.servo_id}: {what}"
        raise ValueError(message)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmSettings:
    """Servos on one bus in joint order.

    Raises:
        ValueError: A setting is invalid.
    """

    port: str
    """Port path, such as /dev/serial/by-id/usb-FTDI_..."""
    servos: tuple[ServoSettings, ...]
    baud: int = 4_000_000
    """Bus rate in bit/s."""
    timeout_s: float = 0.02
    """Timeout in s of an answer, in addition to its bytes."""
    watchdog_s: float = 0.1
    """Silence in s after which the servos end their torque; in steps of 20 ms."""
    lost_after_s: float = 0.06
    """Duration in s of failing reads that counts as a fault."""
    watch_s: float = 0.1
    """Interval in s of checks of torque, hardware errors and bus watchdog."""
    ramp_s: float = 1.0
    """Rise time in s of the caps from 0 after torque is on."""
    release_s: float = 1.0
    """Time in s for lowering the arm at the end, if its modes allow it."""
    release_damping: float = 0.1
    """Damping of a joint in mode 0 while the arm is lowered: fraction of its cap per rad/s."""
    verify_watchdog: bool = True
    """True to trip the bus watchdog once as a test, with torque on and no command."""

    def __post_init__(self) -> None:
        ids = [servo_id for servo in self.servos for servo_id in (servo.servo_id, *servo.shadows)]
        if not (self.servos and len(ids) <= MAX_SERVOS):
            message = f"servos: {len(ids)}: must be 1 to {MAX_SERVOS}"
            raise ValueError(message)
        for servo_id in ids:
            if ids.count(servo_id) > 1:
                message = f"servo {servo_id} is given twice: each must have its own id"
                raise ValueError(message)
        for name, low, high in (
            ("timeout_s", 0.001, 1.0), ("watchdog_s", 0.02, 2.54), ("lost_after_s", 0.0, 1.0), ("watch_s", 0.02, 2.0),
            ("ramp_s", 0.0, 10.0), ("release_s", 0.0, 5.0), ("release_damping", 0.0, 1.0),
        ):  # fmt: skip
            value = getattr(self, name)
            if not low <= value <= high:
                message = f"{name} = {value:g}: must be {low:g} to {high:g}"
                raise ValueError(message)

    @property
    def watchdog_units(self) -> int:
        """Value of address 98 in units of 20 ms, rounded down."""
        return max(1, math.floor(self.watchdog_s / 0.02 + 1e-9))

    @property
    def shadows(self) -> tuple[tuple[ServoSettings, int], ...]:
        """Each shadow with the id that it obeys."""
        return tuple(
            (replace(servo, servo_id=servo_id, shadows=()), servo.servo_id)
            for servo in self.servos
            for servo_id in servo.shadows
        )
