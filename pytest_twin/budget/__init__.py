"""Error budget of a twin: the uncertainty of its records, propagated to the task frame."""
