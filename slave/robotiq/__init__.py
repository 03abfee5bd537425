"""Robotiq grippers on the URCap of a UR arm: driver `robotiq`."""

from typing import TYPE_CHECKING

from haptether.lazy_names import lazy_names

if TYPE_CHECKING:
    from haptether.slave.robotiq.driver import RobotiqGripper

__all__ = ["RobotiqGripper"]

if not TYPE_CHECKING:  # otherwise a type checker would accept any name
    # Users of the models only, such as the emulator, must not load the driver.
    __getattr__, __dir__ = lazy_names(__name__)
