"""Gripper on a servo of an arm's bus: commanded opening, detected object.

The servo is in mode 5: it moves to a position with a capped current, so that blocked jaws press with that current. It
has no bus watchdog and keeps its torque through every fault and end, because losing torque would drop the object. The
cap must therefore be safe for a long stall.
"""

import struct
from dataclasses import dataclass
from typing import Final

from haptether._core import DynamixelBus
from haptether.checklist import Checklist
from haptether.dynamixel.arm.checks import ServoRegisters, check_servo_health
from haptether.dynamixel.arm.faults import ArmFaultError, FaultKind, hardware_error
from haptether.dynamixel.arm.settings import TURN, ServoSettings
from haptether.dynamixel.control_table import (
    CENTRE,
    GOAL_CURRENT,
    PRESENT_TEMPERATURE,
    RAD_PER_TICK,
    RAD_S_PER_UNIT,
    STATUS_SIZE,
    TORQUE_ENABLE,
)
from haptether.dynamixel.models import OperatingMode

GOALS: Final = struct.Struct("<hiIIi")
"""Goal Current, Goal Velocity, Profile Acceleration, Profile Velocity, Goal Position: addresses 102 to 119."""
TIME_PROFILE: Final = 1 << 2
"""Drive mode bit: profiles are times, not speeds."""
LOOK_S: Final = 0.5
"""Interval in s of torque and temperature checks."""
PRESSES: Final = 0.8
"""Fraction of the cap above which the current indicates blocked jaws."""
STANDING: Final = 0.05
"""Fraction of the travel per second below which the jaws stand."""
BESIDE: Final = 0.02
"""Fraction of the travel within which the jaws have reached their goal."""
SLIPPED: Final = 0.05
"""Fraction of the travel after which the jaws no longer hold the object."""
STALL_S: Final = 0.1
"""Time in s of standing and pressing that indicates an object."""
OUTSIDE: Final = 0.1
"""Fraction of the travel by which the jaws may be beyond their ends at the start."""
MARGIN_C: Final = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class GripSettings:
    """Servo of a gripper, and the map from its angle to an opening.

    p = (a - open) / (closed - open), with the angle a from the mechanical centre in the fitting turn. The jaws press
    with F = K_t i / lever: reported with the likely K_t, commanded with the largest.

    Raises:
        ValueError: A setting is invalid.
    """

    servo: ServoSettings
    """Id, model and cap; its limits are those of the jaws, in either order."""
    open_rad: float
    closed_rad: float
    lever_m: float
    """Distance in m from the servo axis to the contact of the jaws."""
    max_speed: float
    """Largest servo speed in rad/s."""

    @property
    def way_rad(self) -> float:
        """Signed angle from open to closed."""
        return self.closed_rad - self.open_rad

    @property
    def most_n(self) -> float:
        """Largest force of the jaws at the cap in N."""
        return self.servo.current_cap_a * self.servo.most_nm_per_a / self.lever_m


class GripServo:
    """State of a gripper's servo on the arm's bus; for one thread.

    Args:
        settings: Settings of the gripper.
    """

    def __init__(self, settings: GripSettings) -> None:
        self.settings = settings
        self.servo_id = settings.servo.servo_id
        self.position = 0.0
        """p, 0 (open) to 1 (closed); not clamped."""
        self.velocity = 0.0
        """Velocity in 1/s."""
        self.force_n = 0.0
        """Motor force between the jaws in N, from the current."""
        self.holds_object = False
        self.fault: ArmFaultError | None = None
        self.temperature_c = 0
        unit_a = settings.servo.servo.current_unit_a
        assert unit_a is not None
        self._unit_a = unit_a
        self._per_tick = RAD_PER_TICK / settings.way_rad
        self._begin_ticks = settings.open_rad / RAD_PER_TICK + CENTRE
        self._turn_ticks = 0.0
        self._goal = 0.0
        self._goal_ticks = 0
        self._cap_units = self._units_of(settings.servo.current_cap_a)
        self._speed_units = self._speed_of(settings.max_speed)
        self._ticks = 0
        self._current_a = 0.0
        self._pressed_s: float | None = None
        self._held_at = 0.0
        self._held_side = 1.0
        self._is_sent = True
        """True if the servo has the goal."""
        self._are_limits_sent = True
        self._look_at_s = 0.0
        self._looks = 0
        self._is_hot = False
        self._is_mended = False
        self._is_measured = False
        """True after the first measurement; before it, contact is unknown."""

    # ------------------------------------------------------------------------------------------------------- begin

    def check(self, bus: DynamixelBus, checklist: Checklist) -> None:
        """Check the servo and set its mode with torque off, unless it has torque in that mode and may hold an object.

        Raises:
            OSError: The servo does not answer, or the port is gone.
            RuntimeError: The servo refuses, or its answer is invalid.
        """
        self._is_measured = False
        servo, what = self.settings.servo, f"servo {self.servo_id} (gripper)"
        registers = ServoRegisters(bus, servo)
        check_servo_health(registers, servo, checklist, what)
        if registers["Operating Mode"] != OperatingMode.CURRENT_BASED_POSITION:
            registers["Torque Enable"] = 0
            registers["Operating Mode"] = OperatingMode.CURRENT_BASED_POSITION
        if registers["Torque Enable"]:
            checklist.ok(what, "has torque and keeps it: it may hold something")
        elif registers["Return Delay Time"]:
            registers["Return Delay Time"] = 0
        checklist.check(
            what, "profiles are speeds", good=not registers["Drive Mode"] & TIME_PROFILE,
            remedy="its profiles are times: clear bit 2 of address 10",
        )  # fmt: skip
        limit_a = registers.scaled("Current Limit")
        checklist.check(
            what, f"cap {servo.current_cap_a:.3f} A of {limit_a:.3f} A, {self.settings.most_n:.1f} N at the jaws",
            good=servo.current_cap_a <= limit_a + 1e-9, remedy="lower cap_a, or raise address 38",
        )  # fmt: skip

    def place(self, bus: DynamixelBus, checklist: Checklist) -> None:
        """Determine the current turn, and check that the jaws are between their ends.

        Raises:
            OSError, RuntimeError: Same as `check`.
        """
        self._ticks = ServoRegisters(bus, self.settings.servo)["Present Position"]
        middle = 0.5 * (self.settings.open_rad + self.settings.closed_rad) / RAD_PER_TICK + CENTRE
        self._turn_ticks = TURN / RAD_PER_TICK * round((middle - self._ticks) / (TURN / RAD_PER_TICK))
        self.position = self._position_of(self._ticks)
        checklist.check(
            f"servo {self.servo_id} (gripper)", f"stands at {self.position:.2f} of 0 (open) to 1 (closed)",
            good=-OUTSIDE <= self.position <= 1.0 + OUTSIDE, remedy="move its jaws, or mend open_rad and closed_rad",
        )  # fmt: skip

    def begin(self, bus: DynamixelBus) -> None:
        """Turn on torque at the current position, without motion; a servo with torque keeps its goal and force.

        Raises:
            OSError, RuntimeError: Same as `check`.
        """
        registers = ServoRegisters(bus, self.settings.servo)
        # A watchdog would end the torque with the bus, and drop the object.
        registers["Bus Watchdog"] = 0
        if registers["Torque Enable"]:
            self._goal_ticks = registers["Goal Position"]
            pressing = abs(registers["Goal Current"])
            self._cap_units = min(pressing, self._units_of(self.settings.servo.current_cap_a))
            if pressing > self._cap_units:
                registers["Goal Current"] = self._cap_units
            self._speed_units = registers["Profile Velocity"]
        else:
            self._cap_units = self._units_of(self.settings.servo.current_cap_a)
            self._speed_units = self._speed_of(self.settings.max_speed)
            registers["Goal Current"] = 0
            registers["Torque Enable"] = 1
            self._ticks = registers["Present Position"]
            registers["Goal Position"] = self._goal_ticks = self._ticks
            registers["Profile Velocity"] = self._speed_units
            registers["Goal Current"] = self._cap_units
        self._goal = self._position_of(self._goal_ticks)
        self._is_sent = self._are_limits_sent = True
        self.fault, self._is_mended = None, False
        self._pressed_s, self.holds_object = None, False

    # -------------------------------------------------------------------------------------------------- every tick

    def take(self, measured: tuple[int, int, int], now_s: float) -> None:
        """Take Present Current, Velocity and Position at a time in s.

        An object is detected if the jaws stand away from their goal while the motor presses towards it with its cap for
        `STALL_S`.
        """
        current_units, velocity_units, ticks = measured
        self._is_measured = True
        closing = 1.0 if self.settings.way_rad > 0.0 else -1.0
        self._ticks = ticks
        self.position = self._position_of(ticks)
        self.velocity = velocity_units * RAD_S_PER_UNIT / self.settings.way_rad
        self._current_a = closing * current_units * self._unit_a
        self.force_n = abs(self._current_a) * self.settings.servo.nm_per_a / self.settings.lever_m
        if self.holds_object:
            # Release the object if it gives way, or if the goal moves to the other side.
            on = (self.position - self._held_at) * self._held_side
            self.holds_object = (self._goal - self._held_at) * self._held_side > BESIDE and on <= SLIPPED
            self._pressed_s = None
        elif not self._presses(PRESSES):
            self._pressed_s = None
        elif self._pressed_s is None:
            self._pressed_s = now_s
        elif now_s - self._pressed_s >= STALL_S:
            self.holds_object, self._held_at = True, self.position
            self._held_side = 1.0 if self._goal > self.position else -1.0

    def write(self, position: float, speed: float, force_n: float) -> None:
        """Set a goal, 0 to 1, with speed in 1/s and force in N, both saturated."""
        settings = self.settings
        way = abs(settings.way_rad)
        speed_units = self._speed_of(min(speed * way, settings.max_speed))
        cap_units = self._units_of(
            min(force_n * settings.lever_m / settings.servo.most_nm_per_a, settings.servo.current_cap_a)
        )
        if (speed_units, cap_units) != (self._speed_units, self._cap_units):
            self._speed_units, self._cap_units, self._are_limits_sent = speed_units, cap_units, False
        self._go(position)

    def hold(self) -> None:
        """Stop moving jaws; pressing jaws keep their goal and force."""
        if self._is_measured and not (self.holds_object or self._presses(0.5 * PRESSES)):
            self._go(self.position)

    @property
    def is_due(self) -> bool:
        """True if the servo lacks the latest goal."""
        return self.fault is None and not (self._is_sent and self._are_limits_sent)

    @property
    def goal(self) -> bytes:
        """Return Goal Position for a sync write of address 116; it counts as sent."""
        self._is_sent = True
        return self._goal_ticks.to_bytes(4, "little", signed=True)

    def send(self, bus: DynamixelBus) -> None:
        """Send force, speed and goal in a separate sync write if the servo lacks them.

        Raises:
            OSError, RuntimeError: Errors of the bus.
        """
        if self.is_due:
            goals = GOALS.pack(self._cap_units, 0, 0, self._speed_units, self._goal_ticks)
            bus.sync_write(GOAL_CURRENT, len(goals), bytes((self.servo_id,)), goals)
            self._is_sent = self._are_limits_sent = True

    @property
    def are_limits_due(self) -> bool:
        """True if the servo lacks force and speed."""
        return self.fault is None and not self._are_limits_sent

    # ------------------------------------------------------------------------------------------------------ faults

    def look(self, bus: DynamixelBus, now_s: float) -> str | None:
        """Check torque or temperature periodically, in one transaction; return a line to report, or None.

        Also repairs an acknowledged fault: reboots a servo with a hardware error.
        """
        if now_s < self._look_at_s:
            return None
        self._look_at_s = now_s + LOOK_S
        try:
            if self.fault is not None:
                return self._mend(bus) if self._is_mended else None
            self._looks += 1
            if self._looks % 2:
                return self._look_at_torque(bus)
            return self._look_at_temperature(bus)
        except (OSError, RuntimeError):
            # The read of all servos detects silent ones.
            return None

    def fail(self, error: ArmFaultError) -> None:
        """Set a fault; nothing more is sent, and the servo keeps its torque."""
        self.fault, self._is_mended = error, False
        self.velocity, self.holds_object = 0.0, False

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault."""
        self._is_mended = self.fault is not None
        self._look_at_s = 0.0

    def _look_at_torque(self, bus: DynamixelBus) -> str | None:
        found = bus.read(self.servo_id, TORQUE_ENABLE, STATUS_SIZE)
        if found[-1]:
            self.fail(hardware_error(self.servo_id, found[-1]))
        elif not found[0]:
            text = f"servo {self.servo_id} (gripper) has no torque: it may have started anew, or something else writes"
            self.fail(ArmFaultError(FaultKind.TORQUE_OFF, f"{text}; see its supply, then acknowledge"))
        return None

    def _look_at_temperature(self, bus: DynamixelBus) -> str | None:
        self.temperature_c = bus.read(self.servo_id, PRESENT_TEMPERATURE, 1)[0]
        # Sync writes are not acknowledged, so resend lost data.
        self._are_limits_sent = False
        limit_c = self.settings.servo.servo.table["Temperature Limit"].default
        was_hot, self._is_hot = self._is_hot, self.temperature_c > limit_c - MARGIN_C
        if self._is_hot and not was_hot:
            return (
                f"gripper: servo {self.servo_id} is at {self.temperature_c} degC; above {limit_c} degC it lets go:"
                " put down what it holds"
            )
        return None

    def _mend(self, bus: DynamixelBus) -> str | None:
        status = bus.read(self.servo_id, TORQUE_ENABLE, STATUS_SIZE)
        if status[-1]:
            bus.reboot(self.servo_id)
            return None
        registers = ServoRegisters(bus, self.settings.servo)
        if registers["Operating Mode"] != OperatingMode.CURRENT_BASED_POSITION:
            self.fail(ArmFaultError(FaultKind.NOT_READY, f"servo {self.servo_id} is not in mode 5: start anew"))
            return None
        self._ticks = registers["Present Position"]
        self.begin(bus)
        return f"gripper: servo {self.servo_id} is ready"

    # ------------------------------------------------------------------------------------------------------- units

    def _presses(self, share: float) -> bool:
        """Return True if the jaws stand away from their goal, with at least a fraction of the cap towards it."""
        left = self._goal - self.position
        towards = self._current_a if left > 0.0 else -self._current_a
        return (
            abs(left) > BESIDE
            and abs(self.velocity) < STANDING
            and towards >= share * max(self._cap_units, 1) * self._unit_a
        )

    def _go(self, position: float) -> None:
        self._goal = position
        ticks = round(self._begin_ticks + position / self._per_tick - self._turn_ticks)
        if ticks != self._goal_ticks:
            self._goal_ticks, self._is_sent = ticks, False

    def _position_of(self, ticks: int) -> float:
        return (ticks + self._turn_ticks - self._begin_ticks) * self._per_tick

    def _units_of(self, current_a: float) -> int:
        # Do not round up the cap; zero current would drop the object.
        return max(1, int(current_a / self._unit_a))

    @staticmethod
    def _speed_of(rad_s: float) -> int:
        # 0 would mean unlimited speed.
        return max(1, int(rad_s / RAD_S_PER_UNIT))
