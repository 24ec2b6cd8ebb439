"""Randomization ranges of a twin: what its records leave uncertain, checked by simulation."""
