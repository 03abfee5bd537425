"""Robot's side: models of arm and environment, interfaces of arm and gripper drivers, the UR arm, Robotiq."""

from typing import TYPE_CHECKING

from haptether._core import ForceSensor, SceneTouch, Wall
from haptether.lazy_names import lazy_names
from haptether.slave.device import SlaveDevice, SlaveSample
from haptether.slave.gripper import Gripper, GripperCommand, GripperSample

if TYPE_CHECKING:
    from haptether.slave.robotiq.driver import RobotiqGripper
    from haptether.slave.robotiq.models import ROBOTIQ_MODELS, RobotiqModel
    from haptether.slave.robotiq.options import RobotiqOptions
    from haptether.slave.ur.driver import UrSlave
    from haptether.slave.ur.kinematics.arm import Rates, UrKinematics
    from haptether.slave.ur.kinematics.chain import UrCalibration, read_calibration
    from haptether.slave.ur.kinematics.constraints import (
        SelfKeepOut,
        StreamingCost,
        StreamingLimits,
        WorkspacePlane,
        model_limits,
    )
    from haptether.slave.ur.kinematics.inverse import UrInverse
    from haptether.slave.ur.kinematics.models import UR_MODELS, UrModel, WrenchSensor, ur_model
    from haptether.slave.ur.kinematics.quadratic import QuadraticProgram
    from haptether.slave.ur.kinematics.streaming import UrStreaming
    from haptether.slave.ur.options import UrOptions

__all__ = [
    "ROBOTIQ_MODELS",
    "UR_MODELS",
    "ForceSensor",
    "Gripper",
    "GripperCommand",
    "GripperSample",
    "QuadraticProgram",
    "Rates",
    "RobotiqGripper",
    "RobotiqModel",
    "RobotiqOptions",
    "SceneTouch",
    "SelfKeepOut",
    "SlaveDevice",
    "SlaveSample",
    "StreamingCost",
    "StreamingLimits",
    "UrCalibration",
    "UrInverse",
    "UrKinematics",
    "UrModel",
    "UrOptions",
    "UrSlave",
    "UrStreaming",
    "Wall",
    "WorkspacePlane",
    "WrenchSensor",
    "model_limits",
    "read_calibration",
    "ur_model",
]

if not TYPE_CHECKING:  # otherwise a type checker would accept any name
    # Without a UR arm NumPy is not loaded.
    __getattr__, __dir__ = lazy_names(__name__)
