"""Staged identification: what measured motion and effort say of a robot's parameters."""
