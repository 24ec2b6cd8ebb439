"""Calibration: joint zeros, link geometry and the frames around a robot, with held-out error."""
