"""Operating systems that pytest-twin runs on."""

from __future__ import annotations

import platform
import sys

_SUPPORTED = ("linux", "darwin")


def unsupported_system() -> str | None:
    """Why pytest-twin refuses to run here, with what to do; None where it runs.

    Models are loaded in child processes with bounds of time and memory, and files are opened
    without following links: both need POSIX.
    """
    if sys.platform in _SUPPORTED:
        return None
    return (
        f"pytest-twin does not run on {platform.system()}, only on Linux and macOS: "
        "use a container or, on Windows, WSL 2"
    )
