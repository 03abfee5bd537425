"""Arm of Dynamixel servos as the slave: `device = "dynamixel"`."""
