"""The side of the robot: arm and environment models, and what a driver of an arm has."""

from haptether._core import Arm, Pusher, Wall
from haptether.slave.device import SlaveDevice, SlaveSample

__all__ = ["Arm", "Pusher", "SlaveDevice", "SlaveSample", "Wall"]
