"""Software environment of a run."""

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
    """Name -> version: ``python``, ``platform``, ``machine``, and all libraries in use."""
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
