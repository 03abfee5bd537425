"""Bounds of each joint's velocity for one period, from speed, acceleration and braking distance."""

import math
from functools import reduce
from typing import Final

from haptether.slave.ur.kinematics.constraints import StreamingLimits
from haptether.slave.ur.kinematics.quadratic import UNBOUNDED
from haptether.slave.ur.kinematics.symbolic import Symbol, casadi_module

# Largest crossing of bounds in rad/s attributed to rounding: a joint that brakes just in time.
CROSSED: Final = 1e-9


def joint_bounds(
    q: Symbol, before: Symbol, limits: StreamingLimits, period_s: float
) -> tuple[list[Symbol], list[Symbol]]:
    """Return the bounds of each joint's velocity by speed, acceleration and braking distance."""
    casadi = casadi_module()
    lower: list[Symbol] = []
    upper: list[Symbol] = []
    for joint in range(6):
        lows: list[Symbol] = [-UNBOUNDED]
        highs: list[Symbol] = [UNBOUNDED]
        if limits.max_speed is not None:
            lows.append(-limits.max_speed[joint])
            highs.append(limits.max_speed[joint])
        step = math.inf
        if limits.max_acceleration is not None:
            step = limits.max_acceleration[joint] * period_s
            lows.append(before[joint] - step)
            highs.append(before[joint] + step)
        if limits.position_min is not None and limits.position_min[joint] > -math.inf:
            lows.append(-_last_speed(q[joint] - limits.position_min[joint], step, period_s))
        if limits.position_max is not None and limits.position_max[joint] < math.inf:
            highs.append(_last_speed(limits.position_max[joint] - q[joint], step, period_s))
        low, high = reduce(casadi.fmax, lows), reduce(casadi.fmin, highs)
        lower.append(low)
        upper.append(casadi.fmax(high, casadi.fmin(low, high + CROSSED)))
    return lower, upper


def _last_speed(distance: Symbol, step: float, period_s: float) -> Symbol:
    """Return the largest velocity from which a joint stops within a distance, if it slows by `step` per period.

    The velocity is v for one period, then v - step, v - 2 step, ... for one period each. With `n = floor(v / step)`
    the joint moves by `T ((n + 1) v - step n (n + 1) / 2)`. So `v = distance / ((n + 1) T) + n step / 2`, with the
    largest n for which `T step n (n + 1) / 2 <= distance`. At or past its end it is 0. The next allowed velocity is
    then at most one step away.
    """
    casadi = casadi_module()
    left = casadi.fmax(distance, 0.0)
    if math.isinf(step):
        return left / period_s
    n = casadi.floor((casadi.sqrt(1 + 8 * left / (step * period_s)) - 1) / 2)
    return left / ((n + 1) * period_s) + n * step / 2
