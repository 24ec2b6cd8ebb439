"""Identification of sensors from recordings of a moving robot."""
