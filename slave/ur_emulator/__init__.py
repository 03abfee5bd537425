"""An emulated UR controller that the real client libraries talk to; `haptether ur-emulator` runs it as a process."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.control import ControlLine
    from haptether.slave.ur_emulator.control_channel import ControlChannel
    from haptether.slave.ur_emulator.controller import Controller, ControllerSettings
    from haptether.slave.ur_emulator.faults import Faults
    from haptether.slave.ur_emulator.robot.contact import ToolEnvironment
    from haptether.slave.ur_emulator.safety_limits import SafetyLimits
    from haptether.slave.ur_emulator.scheduling import realtime
    from haptether.slave.ur_emulator.server import Server
    from haptether.slave.ur_emulator.version import ControllerVersion
    from haptether.slave.ur_emulator.wrench_sensor import WrenchSensing

_PLACES = {
    "ControlChannel": "control_channel",
    "ControlLine": "control",
    "Controller": "controller",
    "ControllerSettings": "controller",
    "ControllerVersion": "version",
    "Faults": "faults",
    "SafetyLimits": "safety_limits",
    "Server": "server",
    "ToolEnvironment": "robot.contact",
    "WrenchSensing": "wrench_sensor",
    "realtime": "scheduling",
}

__all__ = [
    "ControlChannel",
    "ControlLine",
    "Controller",
    "ControllerSettings",
    "ControllerVersion",
    "Faults",
    "SafetyLimits",
    "Server",
    "ToolEnvironment",
    "WrenchSensing",
    "realtime",
]


def __getattr__(name: str) -> object:
    # The kinematics behind most of these are CasADi's, which takes its time.
    if name in _PLACES:
        from importlib import import_module  # noqa: PLC0415

        return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
