"""What the benches of the UR kinematics compare with: arms in pinocchio, other solvers, other formulas."""
