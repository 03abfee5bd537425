"""Leader arm of Dynamixel servos with force feedback by current."""

from haptether.master.dynamixel.compensation import Compensation
from haptether.master.dynamixel.driver import DynamixelMaster
from haptether.master.dynamixel.model import JointModel, PoseModel, joint_model, pose_model
from haptether.master.dynamixel.options import LeaderOptions, leader_options

__all__ = [
    "Compensation",
    "DynamixelMaster",
    "JointModel",
    "LeaderOptions",
    "PoseModel",
    "joint_model",
    "leader_options",
    "pose_model",
]
