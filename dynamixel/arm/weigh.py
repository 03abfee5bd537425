"""The torque constant of one servo, by a known weight on a known lever.

A servo that stands bears tau = K_t i with an error of its dry friction, up or down. So the joint goes slowly up and
down through the same angles: the mean of both currents is that of tau alone, whatever friction takes either way. The
same is done without the weight and with it: the weight of the arm drops out, and

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
"""m/s^2."""
SWING_RAD: Final = 0.1
"""Up and down from where the joint stands."""
SPEED_RAD_S: Final = 0.2
CYCLES: Final = 4
"""The first is left out: the gear's teeth come to lie."""
MIDDLE: Final = 0.6
"""Of each way, amid it: friction has turned by then."""
MOVED: Final = 0.5
"""Least share of the way that the joint must follow."""
TICK_S: Final = 0.004
LEAST_UNITS: Final = 20
"""Of the current, between without and with the weight."""
MOST_SHARE: Final = 0.15
"""A measurement that is less certain is refused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WeighedConstant:
    """What was measured of one servo."""

    nm_per_a: float
    """K_t."""
    uncertainty_nm_per_a: float
    """Two standard deviations of the currents, a unit of the current, and the tolerance of the weight."""
    friction_a: float
    """Half of what lies between up and down, with the weight, in A."""


def weighed_constant(
    servo: ServoSettings,
    load_nm: float,
    tolerance: float,
    without: list[tuple[float, float]],
    with_weight: list[tuple[float, float]],
) -> WeighedConstant:
    """K_t of a servo.

    Args:
        servo: One with current control.
        load_nm: m g l.
        tolerance: Of that, as a share.
        without: Mean currents in A upwards and downwards, of each cycle, without the weight.
        with_weight: The same with it.

    Raises:
        ValueError: Currents that differ too little, or scatter too much: what to do.
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
    """Leads one joint of an open arm that holds all of its joints by goals.

    Args:
        arm: Open, its servos in modes 4 and 5.
        joint: Its index.
    """

    def __init__(self, arm: ServoArm, joint: int) -> None:
        self._arm = arm
        self._joint = joint
        self._goals: list[float] | None = None

    def hold(self, until: Callable[[], bool]) -> None:
        """Holds all joints where they are until something is so.

        Raises:
            RuntimeError: A fault of the arm, which has no torque then.
        """
        while not until():
            self._tick(0.0)

    def swing(self) -> list[tuple[float, float]]:
        """Mean currents in A of the joint upwards and downwards, of each cycle after the first.

        Raises:
            RuntimeError: A fault of the arm, or a joint that does not follow.
        """
        way_s = 2.0 * SWING_RAD / SPEED_RAD_S
        ways: list[list[tuple[float, float]]] = [[] for _ in range(2 * CYCLES + 1)]
        # From the middle of the first way to that of the last, so that no goal jumps.
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
        """Leads the joint to a place beside where it stood; its angle and its current."""
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
