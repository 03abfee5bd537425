"""Emulated UR controller that the real client libraries talk to; `haptether ur-emulator` runs it as a process."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.connections import Faults
    from haptether.slave.ur_emulator.control import ControlLine
    from haptether.slave.ur_emulator.controller import Controller, ControllerSettings
    from haptether.slave.ur_emulator.gripper.gripper import EmulatedGripper, GrippedObject, GripperSettings
    from haptether.slave.ur_emulator.robot.contact import ToolEnvironment, WrenchSensing
    from haptether.slave.ur_emulator.robot.safety import SafetyLimits
    from haptether.slave.ur_emulator.rtde.variables import ControllerVersion
    from haptether.slave.ur_emulator.server import Server

_MODULES = {
    "ControlLine": "control",
    "Controller": "controller",
    "ControllerSettings": "controller",
    "ControllerVersion": "rtde.variables",
    "EmulatedGripper": "gripper.gripper",
    "Faults": "connections",
    "GrippedObject": "gripper.gripper",
    "GripperSettings": "gripper.gripper",
    "SafetyLimits": "robot.safety",
    "Server": "server",
    "ToolEnvironment": "robot.contact",
    "WrenchSensing": "robot.contact",
}

__all__ = [
    "ControlLine",
    "Controller",
    "ControllerSettings",
    "ControllerVersion",
    "EmulatedGripper",
    "Faults",
    "GrippedObject",
    "GripperSettings",
    "SafetyLimits",
    "Server",
    "ToolEnvironment",
    "WrenchSensing",
]


def __getattr__(name: str) -> object:
    # Most of these modules import CasADi, which is slow.
    if name in _MODULES:
        from importlib import import_module  # noqa: PLC0415

        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
