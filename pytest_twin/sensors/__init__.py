"""Sensor models from true signal to reading, one file for each sensor, with their estimation."""
