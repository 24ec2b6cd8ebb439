"""What checks can feel of a compiled model: parts by name, and how they hang together.

Everything is read from the compiled model, so that comments, default classes, includes, the way
an angle is written, and what is only seen change nothing.
"""
