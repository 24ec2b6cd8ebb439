"""Algebraic solvers of hand-eye and robot-world calibration, and their comparison."""
