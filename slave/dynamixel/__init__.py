"""An arm of Dynamixel servos as the slave: `device = "dynamixel"`."""
