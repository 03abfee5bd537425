"""Robotiq grippers on the URCap of a UR arm: driver `robotiq`."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.slave.robotiq.driver import RobotiqGripper

__all__ = ["RobotiqGripper"]


def __getattr__(name: str) -> object:
    # Users of the models only, such as the emulator, must not load the driver.
    if name == "RobotiqGripper":
        from haptether.slave.robotiq.driver import RobotiqGripper  # noqa: PLC0415

        return RobotiqGripper
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
