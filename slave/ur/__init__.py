"""The driver of a UR arm, `device = "ur"`, and the arm's kinematics."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.slave.ur.driver import UrSlave

__all__ = ["UrSlave"]


def __getattr__(name: str) -> object:
    # Whoever wants the options, or the kinematics, does not wait for the driver.
    if name == "UrSlave":
        from haptether.slave.ur.driver import UrSlave  # noqa: PLC0415

        return UrSlave
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
