"""Which effects explain the recordings: rivals, simulated and held against each other."""
