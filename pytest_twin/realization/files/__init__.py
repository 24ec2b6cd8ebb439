"""Find the files that a model refers to, and decide which folders may contain them.

``root`` contains the rules and reads no files; ``surroundings`` and ``packages`` inspect folders;
``locate`` combines them. This package imports no simulator.
"""
