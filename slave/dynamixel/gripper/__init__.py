"""Gripper on a servo of its arm's bus: `[slave.gripper] device = "dynamixel"`."""
