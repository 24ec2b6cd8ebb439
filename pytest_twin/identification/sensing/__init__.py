"""Sensors from recordings of a moving robot."""
