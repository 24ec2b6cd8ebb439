"""Metrics of time, frequency and pose: pure functions of arrays."""
