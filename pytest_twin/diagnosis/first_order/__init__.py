"""First-order effect of every candidate along the measured motion, without simulation."""
