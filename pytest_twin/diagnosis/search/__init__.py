"""Comparison of models by simulation, and rejection of unsupported effects."""
