"""Driver of a UR arm, `device = "ur"`, and the arm's kinematics."""
