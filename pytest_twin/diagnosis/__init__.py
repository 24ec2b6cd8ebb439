"""Locate the mismatch, name the missing physics, model it, show what it buys."""
