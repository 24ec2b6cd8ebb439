"""Calibration targets with a printed pattern, found in images."""
