"""Delay of an arm's motion, from commands and measurements."""

import math

import numpy as np
import pytest
from scipy import signal

from haptether.slave.ur.motion import Latency

PERIOD_S = 0.002


@pytest.mark.parametrize("delay_s", [0.0, 0.0137, 0.05, 0.21])
def test_a_pure_delay_is_found(delay_s: float) -> None:
    latency = Latency(PERIOD_S)
    for tick in range(3000):
        t = tick * PERIOD_S
        latency.add(t, wave(t), wave(t - delay_s) + 0.004)
    # The estimate interpolates linearly: its error is far below a sample.
    assert latency.seconds == pytest.approx(delay_s, abs=1e-4)


def wave(t: float) -> float:
    return 0.03 * math.sin(2.1 * t) + 0.01 * math.sin(5.3 * t + 1.0)


def test_a_second_order_lag_is_its_delay_for_slow_motion() -> None:
    """The servoj model `q'' = gain (q_set - q - lookahead q')` lags on a ramp by the lookahead."""
    gain, lookahead_s = 1000.0, 0.05
    times = np.arange(0.0, 8.0, PERIOD_S)
    commanded = 0.05 * np.sin(1.0 * times)
    _, measured, _ = signal.lsim(([gain], [1.0, gain * lookahead_s, gain]), commanded, times)
    latency = Latency(PERIOD_S)
    for row in zip(times, commanded, measured, strict=True):
        latency.add(*map(float, row))
    # Phase of the system at 1 rad/s, over 1 rad/s.
    phase = math.atan2(gain * lookahead_s, gain - 1.0)
    assert latency.seconds == pytest.approx(phase, abs=5e-4)


def test_an_arm_that_rests_has_none() -> None:
    latency = Latency(PERIOD_S)
    assert latency.seconds is None
    for tick in range(2000):
        latency.add(tick * PERIOD_S, 0.1, 0.1 + 1e-5 * math.sin(tick))
    assert latency.seconds is None
    latency.clear()
    assert latency.seconds is None
