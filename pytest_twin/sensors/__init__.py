"""What a sensor makes of the true signal: one file for each sensor, with how it is estimated."""
