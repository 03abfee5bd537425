"""The side of the hand: haptic device and human-hand models."""

from haptether._core import Hand, HapticDevice

__all__ = ["Hand", "HapticDevice"]
