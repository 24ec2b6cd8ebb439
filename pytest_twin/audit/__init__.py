"""Check a robot's file for impossible, implausible and missing values: one module per layer."""
