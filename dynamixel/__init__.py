"""Bus of Dynamixel servos for leader and follower arms: protocol, control tables, models, emulator."""

from haptether._core import DynamixelBus, SyncRead
from haptether.dynamixel.control_table import ControlTable, Item
from haptether.dynamixel.models import (
    BAUD_RATES,
    SERVO_MODELS,
    SERVO_MODELS_BY_NUMBER,
    OperatingMode,
    ServoModel,
    Stall,
)

__all__ = [
    "BAUD_RATES",
    "SERVO_MODELS",
    "SERVO_MODELS_BY_NUMBER",
    "ControlTable",
    "DynamixelBus",
    "Item",
    "OperatingMode",
    "ServoModel",
    "Stall",
    "SyncRead",
]
