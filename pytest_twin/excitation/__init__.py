"""Excitation: motion within approved limits, and what it will and will not identify."""
