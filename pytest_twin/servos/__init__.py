"""A library of identified servos: laws, parameters, intervals, conditions and evidence."""
