"""Ticks of haptic drivers with a force, until a condition holds."""

import time
from collections.abc import Callable
from contextlib import closing
from typing import TypeVar

import numpy as np

from haptether.master import MasterSample
from haptether.master.force_dimension import ForceDimension
from haptether.master.inverse3 import Inverse3
from haptether.master.touch import Touch

Driver = TypeVar("Driver", ForceDimension, Inverse3, Touch)

REST = (0.0, 0.0, 0.0)
HALF = 0.5**0.5
STIFFNESS = 200.0
"""Stiffness in N/m of the hand that holds the stand-in."""


def begun(driver: Driver) -> closing[Driver]:
    """Open a driver; the returned context closes it."""
    driver.open()
    return closing(driver)


def step(
    driver: Driver, force: tuple[float, ...] = REST, ticks: int = 1, torque: tuple[float, ...] | None = None
) -> MasterSample:
    """Run some ticks with a force; return the last sample."""
    for _ in range(ticks):
        sample = driver.read()
        driver.write(force, torque)
        if not driver.paces:
            time.sleep(0.001)
    return sample


def until(driver: Driver, done: Callable[[MasterSample], bool], force: tuple[float, ...] = REST) -> MasterSample:
    """Step until the condition holds; a frame that is late on a busy machine is acknowledged."""
    end_s = time.monotonic() + 10.0
    while not done(sample := step(driver, force)):
        assert time.monotonic() < end_s, sample
        if sample.fault is not None and "no frame of the vendor" in sample.fault:
            driver.acknowledge()
    return sample


def at_rest(sample: MasterSample) -> bool:
    return sample.fault is None and sample.velocity is not None and bool(np.allclose(sample.velocity, 0.0, atol=1e-3))
