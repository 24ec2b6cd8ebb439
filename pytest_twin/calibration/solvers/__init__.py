"""Algebraic solvers of hand-eye and robot-world calibration, and how to compare them."""
