"""The side of the robot: arm and environment models."""

from haptether._core import Arm, Pusher, Wall

__all__ = ["Arm", "Pusher", "Wall"]
