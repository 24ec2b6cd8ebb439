"""What a run ran on."""

from __future__ import annotations

import platform
from importlib import metadata

DISTRIBUTIONS = (
    "pytest-twin",
    "pytest",
    "mujoco",
    "pin",
    "coal",
    "numpy",
    "scipy",
    "mcap",
    "trimesh",
    "securesystemslib",
    "cryptography",
)


def environment() -> dict[str, str]:
    """``python``, ``platform`` and ``machine``, and the version of every library in use."""
    found = {
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "platform": platform.platform(terse=True),
        "machine": platform.machine(),
    }
    for name in DISTRIBUTIONS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
