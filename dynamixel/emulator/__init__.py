"""Emulated servos on a bus, for real clients; `haptether dynamixel-emulator` runs them as a process."""

from haptether.dynamixel.emulator.bus import Answer, Bus, Faults
from haptether.dynamixel.emulator.control import ControlLine
from haptether.dynamixel.emulator.joint import JointSettings
from haptether.dynamixel.emulator.server import Server
from haptether.dynamixel.emulator.servo import HardwareError, Servo

__all__ = ["Answer", "Bus", "ControlLine", "Faults", "HardwareError", "JointSettings", "Server", "Servo"]
