"""Residual models and online parameter updates, tested against a base model before release."""
