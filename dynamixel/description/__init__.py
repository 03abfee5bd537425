"""Description of a servo arm in a TOML file, with kinematics and gravity."""

from haptether.dynamixel.description.kinematics import ArmKinematics
from haptether.dynamixel.description.load import ArmDescriptionError, arm_names, load_arm
from haptether.dynamixel.description.tables import ArmDescription, Joint, Link, Tool, Trigger

__all__ = [
    "ArmDescription",
    "ArmDescriptionError",
    "ArmKinematics",
    "Joint",
    "Link",
    "Tool",
    "Trigger",
    "arm_names",
    "load_arm",
]
