"""Observations from recordings: joint states, images and poses while the robot stands still."""
