"""Randomization ranges of a twin, from the uncertainty of its records, checked by simulation."""
