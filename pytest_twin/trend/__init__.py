"""Parameters of one robot over dated recordings: bands, changes and alarms."""
