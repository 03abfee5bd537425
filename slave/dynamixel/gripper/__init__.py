"""A gripper on a servo of the bus of its arm: `[slave.gripper] device = "dynamixel"`."""
