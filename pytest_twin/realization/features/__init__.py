"""Parts and structure of a compiled model, for the dependency map.

All values are read from the compiled model. Comments, default classes, includes, the notation of
angles, and visual properties therefore change no part.
"""
