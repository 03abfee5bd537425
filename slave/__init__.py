"""The side of the robot: arm and environment models, what a driver of an arm has, the UR arm and its kinematics."""

from importlib import import_module
from typing import TYPE_CHECKING, Final

from haptether._core import Arm, ForceSensor, Pusher, SceneTouch, Wall
from haptether.slave.device import SlaveDevice, SlaveSample

if TYPE_CHECKING:
    from haptether.slave.ur.driver import UrSlave
    from haptether.slave.ur.kinematics.arm import Rates, UrKinematics
    from haptether.slave.ur.kinematics.calibration import UrCalibration, read_calibration
    from haptether.slave.ur.kinematics.constraints import (
        SelfKeepOut,
        StreamingCost,
        StreamingLimits,
        WorkspacePlane,
        model_limits,
    )
    from haptether.slave.ur.driver import UrSlave
    from haptether.slave.ur.options import UrOptions
    from haptether.slave.ur_calibration import UrCalibration, read_calibration
    from haptether.slave.ur_inverse import UrInverse
    from haptether.slave.ur_kinematics import Rates, UrKinematics
    from haptether.slave.ur_models import UR_MODELS, UrModel, WrenchSensor, ur_model
    from haptether.slave.ur_streaming import UrStreaming

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
    "UR_MODELS": "ur_models",
    "QuadraticProgram": "quadratic_solver",
    "Rates": "ur_kinematics",
    "SelfKeepOut": "streaming_limits",
    "StreamingCost": "streaming_limits",
    "StreamingLimits": "streaming_limits",
    "UrCalibration": "ur_calibration",
    "UrInverse": "ur_inverse",
    "UrKinematics": "ur_kinematics",
    "UrModel": "ur_models",
    "UrOptions": "ur.options",
    "UrSlave": "ur.driver",
    "UrStreaming": "ur_streaming",
    "WorkspacePlane": "streaming_limits",
    "WrenchSensor": "ur_models",
    "model_limits": "streaming_limits",
    "read_calibration": "ur_calibration",
    "ur_model": "ur_models",
}


def __getattr__(name: str) -> object:
    if name in WHERE:
        return getattr(import_module(f"haptether.slave.{WHERE[name]}"), name)
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
