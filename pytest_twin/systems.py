"""Check of the operating system."""

from __future__ import annotations

import platform
import sys

_SUPPORTED = ("linux", "darwin")


def unsupported_system() -> str | None:
    """Why pytest-twin cannot run on this system, and what to do; None where it can.

    pytest-twin limits the time and memory of child processes that load models, and opens files
    without following symbolic links. Both need POSIX.
    """
    if sys.platform in _SUPPORTED:
        return None
    return (
        f"pytest-twin does not run on {platform.system()}, only on Linux and macOS: "
        "use a container or, on Windows, WSL 2"
    )
