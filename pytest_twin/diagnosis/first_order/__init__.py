"""What every candidate would add along the measured motion, to first order, unsimulated."""
