"""Identification from measured effort by inverse dynamics, which are linear in the parameters."""
