"""The gate: what runs and why, whether it passes, and what is signed."""
