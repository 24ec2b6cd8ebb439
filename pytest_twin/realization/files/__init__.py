"""Where the files that a model names may lie, and how each reference is found.

``root`` decides and is pure; ``surroundings`` and ``packages`` look at folders; ``locate`` puts
them together. Nothing is imported here: the process of the command line needs no simulator.
"""
