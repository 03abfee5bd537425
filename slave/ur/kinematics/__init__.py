"""Kinematics of UR arms: models, poses, forward and inverse kinematics, joint velocity streaming within limits."""
