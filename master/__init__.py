"""Operator's side: models of haptic device and hand, and the interface of a device driver."""

from haptether._core import Hand, HapticDevice
from haptether.master.device import MasterDevice, MasterSample
from haptether.master.presets import DEVICE_PRESETS, DevicePreset

__all__ = ["DEVICE_PRESETS", "DevicePreset", "Hand", "HapticDevice", "MasterDevice", "MasterSample"]
