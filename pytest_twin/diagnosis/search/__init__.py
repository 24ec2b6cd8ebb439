"""Stepwise selection of effects by simulation, and rejection of unsupported ones."""
