"""Excitation: design motions within approved limits, and predict what they identify."""
