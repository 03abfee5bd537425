"""The gripper on the emulated arm, behind the server of the URCap."""
