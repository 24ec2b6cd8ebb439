"""The error budget of a twin: what its records leave uncertain, and how far that moves the task."""
