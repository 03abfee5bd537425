"""Kinematics of UR arms: models, poses, forward and inverse kinematics, streamed joint velocities within limits."""
