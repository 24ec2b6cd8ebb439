"""Identification from measured effort: inverse dynamics, linear in the parameters."""
