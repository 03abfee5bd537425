"""The side of the hand: haptic device and human-hand models, and what a driver of a device has."""

from haptether._core import Hand, HapticDevice
from haptether.master.device import MasterDevice, MasterSample
from haptether.master.presets import DEVICE_PRESETS, DevicePreset

__all__ = ["DEVICE_PRESETS", "DevicePreset", "Hand", "HapticDevice", "MasterDevice", "MasterSample"]
