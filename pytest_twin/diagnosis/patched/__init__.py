"""The model with what was found: written, read back and replayed."""
