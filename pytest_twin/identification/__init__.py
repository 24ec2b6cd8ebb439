"""Staged identification of a robot's parameters from measured motion and effort."""
