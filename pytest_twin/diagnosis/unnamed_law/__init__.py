"""Fit free laws (tables over one variable) to residuals that no catalogued effect explains."""
