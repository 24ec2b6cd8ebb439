"""Locate, name, model and show: why a simulation and recordings differ."""
