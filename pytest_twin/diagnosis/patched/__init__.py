"""Realization with the diagnosed effects: write, read and replay it."""
