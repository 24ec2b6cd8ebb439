"""Write the files that accompany ``ranges.json``: a sampler and simulator configurations."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pytest_twin.formats import atomic

FILES = ("sampler.py", "mjx_randomize.py", "isaaclab_events.py", "mjlab_events.py")
"""Each file reads ``ranges.json`` in its folder and does not import this package."""


def write_files(folder: Path) -> None:
    """Write the sampler and the configurations into a folder.

    Raises:
        PathError: a file cannot be written.
    """
    source = resources.files("pytest_twin.ranges") / "written"
    for name in FILES:
        atomic.write_text(folder / name, (source / name).read_text(encoding="utf-8"))
