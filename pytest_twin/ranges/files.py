"""What is written beside ``ranges.json``: a sampler, and configurations of simulators."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pytest_twin.formats import atomic

FILES = ("sampler.py", "mjx_randomize.py", "isaaclab_events.py", "mjlab_events.py")
"""Each reads ``ranges.json`` beside it and imports nothing of this package."""


def write_files(folder: Path) -> None:
    """Write the sampler and the configurations into a folder.

    Raises:
        PathError: it cannot be written.
    """
    source = resources.files("pytest_twin.ranges") / "written"
    for name in FILES:
        atomic.write_text(folder / name, (source / name).read_text(encoding="utf-8"))
