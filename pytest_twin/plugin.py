"""The pytest door: golden specs become items, a session becomes a verdict."""
