"""Which effects explain the recordings: rivals, simulated and compared with each other."""
