"""Emulated servos on a bus for real clients; `haptether dynamixel-emulator` runs them as a process."""

from haptether.dynamixel.emulator.bus import Answer, Bus, Faults
from haptether.dynamixel.emulator.control import ControlLine, set_stops
from haptether.dynamixel.emulator.joint import HeldBy, Joint, JointSettings
from haptether.dynamixel.emulator.load import ArmLoad, mounted, servos_of
from haptether.dynamixel.emulator.server import Server
from haptether.dynamixel.emulator.servo import HardwareError, Servo
from haptether.dynamixel.emulator.tcp import StreamLine, TcpLine, UnixLine

__all__ = [
    "Answer",
    "ArmLoad",
    "Bus",
    "ControlLine",
    "Faults",
    "HardwareError",
    "HeldBy",
    "Joint",
    "JointSettings",
    "Server",
    "Servo",
    "StreamLine",
    "TcpLine",
    "UnixLine",
    "mounted",
    "servos_of",
    "set_stops",
]
