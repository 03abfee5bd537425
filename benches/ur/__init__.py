"""Peers of the UR kinematics benches: arms in pinocchio, other solvers, other formulas."""
