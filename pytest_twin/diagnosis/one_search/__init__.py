"""The search of a diagnosis: one incumbent, one pool of simulated models, one acceptance test."""
