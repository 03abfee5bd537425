"""The bus of Dynamixel servos, for leader arms and follower arms: control tables, models, and an emulator."""

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
    "Item",
    "OperatingMode",
    "ServoModel",
    "Stall",
]
