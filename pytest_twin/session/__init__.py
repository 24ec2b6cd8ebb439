"""Pytest session with twins: test items, plans, verdicts. Imported only when a twin is found."""
