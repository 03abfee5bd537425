"""The side of the robot: arm and environment models, what a driver of an arm has, the UR arm and its kinematics."""

from importlib import import_module
from typing import TYPE_CHECKING, Final

from haptether._core import Arm, ForceSensor, Pusher, SceneTouch, Wall
from haptether.slave.device import SlaveDevice, SlaveSample

if TYPE_CHECKING:
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
    from haptether.slave.ur.kinematics.streaming import QuadraticProgram, UrStreaming
    from haptether.slave.ur.options import UrOptions

__all__ = [
    "UR_MODELS",
    "Arm",
    "ForceSensor",
    "Pusher",
    "QuadraticProgram",
    "Rates",
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

# Whoever has no UR arm does not wait for NumPy.
WHERE: Final = {
    "UR_MODELS": "ur.kinematics.models",
    "QuadraticProgram": "ur.kinematics.streaming",
    "Rates": "ur.kinematics.arm",
    "SelfKeepOut": "ur.kinematics.constraints",
    "StreamingCost": "ur.kinematics.constraints",
    "StreamingLimits": "ur.kinematics.constraints",
    "UrCalibration": "ur.kinematics.chain",
    "UrInverse": "ur.kinematics.inverse",
    "UrKinematics": "ur.kinematics.arm",
    "UrModel": "ur.kinematics.models",
    "UrOptions": "ur.options",
    "UrSlave": "ur.driver",
    "UrStreaming": "ur.kinematics.streaming",
    "WorkspacePlane": "ur.kinematics.constraints",
    "WrenchSensor": "ur.kinematics.models",
    "model_limits": "ur.kinematics.constraints",
    "read_calibration": "ur.kinematics.chain",
    "ur_model": "ur.kinematics.models",
}


def __getattr__(name: str) -> object:
    if name in WHERE:
        return getattr(import_module(f"haptether.slave.{WHERE[name]}"), name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
