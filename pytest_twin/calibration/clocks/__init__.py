"""Two pose streams on two clocks: their offset and drift."""
