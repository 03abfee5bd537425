"""Gripper on the emulated arm, behind the URCap server."""
