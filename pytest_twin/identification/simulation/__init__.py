"""Identification from commands and positions alone: simulation of the closed loop."""
