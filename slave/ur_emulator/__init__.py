"""Emulated UR controller that the real client libraries talk to; `haptether ur-emulator` runs it as a process."""

from typing import TYPE_CHECKING

from haptether.lazy_names import lazy_names

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.connections import Faults
    from haptether.slave.ur_emulator.control import ControlLine
    from haptether.slave.ur_emulator.controller import Controller, ControllerSettings
    from haptether.slave.ur_emulator.gripper.gripper import EmulatedGripper, GrippedObject, GripperSettings
    from haptether.slave.ur_emulator.robot.contact import ToolEnvironment, WrenchSensing
    from haptether.slave.ur_emulator.robot.safety import SafetyLimits
    from haptether.slave.ur_emulator.rtde.variables import ControllerVersion
    from haptether.slave.ur_emulator.server import Server

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

if not TYPE_CHECKING:  # otherwise a type checker would accept any name
    # Most of these modules import CasADi, which is slow.
    __getattr__, __dir__ = lazy_names(__name__)
