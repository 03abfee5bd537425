"""Measurement of a servo's torque constant with a known weight on a known lever.

A standing servo bears tau = K_t i with an error of its dry friction in either direction. Therefore the joint moves
slowly up and down through the same angles, and the mean of both currents removes the friction. A repetition without the
weight removes the weight of the arm:

    K_t = m g l / |i_with - i_without|
"""

import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from haptether.dynamixel.arm.arm import ServoArm
from haptether.dynamixel.arm.settings import ServoSettings

GRAVITY: Final = 9.81
"""Gravity in m/s^2."""
SWING_RAD: Final = 0.1
"""Amplitude in rad around the initial angle."""
SPEED_RAD_S: Final = 0.2
CYCLES: Final = 4
"""The first cycle is dropped, because the gear teeth settle in it."""
MIDDLE: Final = 0.6
"""Middle fraction of each sweep that is used, after friction has reversed."""
MOVED: Final = 0.5
"""Smallest fraction of the sweep that the joint must follow."""
TICK_S: Final = 0.004
LEAST_UNITS: Final = 20
"""Smallest difference of the current with and without the weight, in units."""
MOST_SHARE: Final = 0.15
"""Largest relative uncertainty of a valid measurement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WeighedConstant:
    """Result for one servo."""

    nm_per_a: float
    """K_t in N m/A."""
    uncertainty_nm_per_a: float
    """Two standard deviations of the currents, one unit of current, and the tolerance of the weight, combined."""
    friction_a: float
    """Half the difference between upward and downward current with the weight, in A."""


def weighed_constant(
    servo: ServoSettings,
    load_nm: float,
    tolerance: float,
    without: list[tuple[float, float]],
    with_weight: list[tuple[float, float]],
) -> WeighedConstant:
    """Compute K_t of a servo.

    Args:
        servo: Servo with current control.
        load_nm: m g l in N m.
        tolerance: Relative tolerance of the load.
        without: Mean upward and downward currents in A of each cycle, without the weight.
        with_weight: The same with the weight.

    Raises:
        ValueError: The currents differ too little, or scatter too much; gives a remedy.
    """
    unit_a = servo.servo.current_unit_a
    assert unit_a is not None
    middles = [[0.5 * (up + down) for up, down in cycles] for cycles in (without, with_weight)]
    before, after = (statistics.fmean(cycles) for cycles in middles)
    difference = abs(after - before)
    if difference < LEAST_UNITS * unit_a:
        message = (
            f"servo {servo.servo_id}: the weight of {load_nm:.3f} N m changes its current by {1e3 * difference:.1f} mA:"
            f" must be {1e3 * LEAST_UNITS * unit_a:.0f} mA or more: take a heavier weight or a longer lever"
        )
        raise ValueError(message)
    scatter = math.hypot(*(2.0 * statistics.stdev(cycles) / math.sqrt(len(cycles)) for cycles in middles), unit_a)
    constant = load_nm / difference
    share = math.hypot(tolerance, scatter / difference)
    if share > MOST_SHARE:
        message = (
            f"servo {servo.servo_id}: K_t = {constant:.3f} N m/A is certain to {100.0 * share:.0f} % only: must be"
            f" {100.0 * MOST_SHARE:.0f} % or less: take a heavier weight, and keep the arm still"
        )
        raise ValueError(message)
    friction = statistics.fmean(0.5 * abs(up - down) for up, down in with_weight)
    return WeighedConstant(nm_per_a=constant, uncertainty_nm_per_a=share * constant, friction_a=friction)


class Weighing:
    """Move one joint of an open arm that holds all joints by goals.

    Args:
        arm: Open arm with servos in modes 4 and 5.
        joint: Index of the joint.
    """

    def __init__(self, arm: ServoArm, joint: int) -> None:
        self._arm = arm
        self._joint = joint
        self._goals: list[float] | None = None

    def hold(self, until: Callable[[], bool]) -> None:
        """Hold all joints in place until a condition is true.

        Raises:
            RuntimeError: The arm has a fault, and thus no torque.
        """
        while not until():
            self._tick(0.0)

    def swing(self) -> list[tuple[float, float]]:
        """Return mean upward and downward currents of the joint in A for each cycle after the first.

        Raises:
            RuntimeError: The arm has a fault, or the joint does not follow.
        """
        way_s = 2.0 * SWING_RAD / SPEED_RAD_S
        ways: list[list[tuple[float, float]]] = [[] for _ in range(2 * CYCLES + 1)]
        # Start and end in the middle of a sweep, so that no goal jumps.
        begin_s = time.monotonic() - 0.5 * way_s
        while (passed := (time.monotonic() - begin_s) / way_s) < len(ways) - 0.5:
            way, share = int(passed), passed % 1.0
            measured = self._tick(SWING_RAD * (2.0 * share - 1.0) * (1.0 if way % 2 == 0 else -1.0))
            if measured is not None and abs(share - 0.5) <= 0.5 * MIDDLE:
                ways[way].append(measured)
        return [(self._mean(up), self._mean(down)) for up, down in zip(ways[2:-1:2], ways[3::2], strict=True)]

    def _mean(self, way: list[tuple[float, float]]) -> float:
        moved = abs(way[-1][0] - way[0][0]) if way else 0.0
        wanted = 2.0 * SWING_RAD * MIDDLE
        if moved < MOVED * wanted:
            message = (
                f"servo {self._arm.settings.servos[self._joint].servo_id} moved {moved:.3f} rad where {wanted:.3f} were"
                " commanded: raise its cap_a, take a lighter weight, and see that nothing holds the joint"
            )
            raise RuntimeError(message)
        return statistics.fmean(current for _, current in way)

    def _tick(self, offset_rad: float) -> tuple[float, float] | None:
        """Command an offset from the initial angle; return angle and current."""
        arm, measured = self._arm, None
        if arm.read():
            if self._goals is None:
                self._goals = arm.position.tolist()
            measured = float(arm.position[self._joint]), float(arm.current[self._joint])
        if arm.fault is not None:
            raise RuntimeError(arm.fault)
        if self._goals is not None:
            goals = list(self._goals)
            goals[self._joint] += offset_rad
            arm.write_positions(goals)
        time.sleep(TICK_S)
        return measured
