"""Emulated Inverse Service: an Inverse3 with a hand and a VerseGrip, for the driver and other clients."""

from haptether.master.inverse3.emulator.control import ControlLine
from haptether.master.inverse3.emulator.device import EmulatedInverse3, EmulatedSettings
from haptether.master.inverse3.emulator.server import Server
from haptether.master.inverse3.emulator.service import Service

__all__ = ["ControlLine", "EmulatedInverse3", "EmulatedSettings", "Server", "Service"]
