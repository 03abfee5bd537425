"""Servo arm on one bus, the common base of leader and follower."""

from haptether.dynamixel.arm.arm import ServoArm, Vector
from haptether.dynamixel.arm.calibration import calibration_text, read_calibration, write_calibration
from haptether.dynamixel.arm.checks import ArmRefusedError
from haptether.dynamixel.arm.compensation import JointCompensation
from haptether.dynamixel.arm.faults import ArmFaultError, FaultKind
from haptether.dynamixel.arm.grip import GripServo, GripSettings
from haptether.dynamixel.arm.plausible import MAX_DOUBTFUL
from haptether.dynamixel.arm.settings import ArmSettings, ServoSettings

__all__ = [
    "MAX_DOUBTFUL",
    "ArmFaultError",
    "ArmRefusedError",
    "ArmSettings",
    "FaultKind",
    "GripServo",
    "GripSettings",
    "JointCompensation",
    "ServoArm",
    "ServoSettings",
    "Vector",
    "calibration_text",
    "read_calibration",
    "write_calibration",
]
