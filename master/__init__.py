"""The side of the hand: haptic device and human-hand models."""

from haptether._core import Hand, HapticDevice
from haptether.master.presets import DEVICE_PRESETS, DevicePreset

__all__ = ["DEVICE_PRESETS", "DevicePreset", "Hand", "HapticDevice"]
