"""Software environment of a run."""

from __future__ import annotations

import platform
from importlib import metadata

from pytest_twin.release.statement import Release
from pytest_twin.words import counted

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


ENGINES = {"mujoco": "MuJoCo", "pin": "Pinocchio"}
"""Distribution -> engine whose version a release states."""


def environment() -> dict[str, str]:
    """Name -> version: ``python``, ``platform``, ``machine``, and all libraries in use."""
    found = {
        "python": f"{platform.python_implementation()} {platform.python_version()}",
        "platform": platform.platform(terse=True),
        "machine": platform.machine(),
    }
    return found | {name: _version(name) for name in DISTRIBUTIONS}


def engine_changes(release: Release) -> list[str]:
    """A line for each engine of another version than at a release, with the goldens it leaves."""
    lines = []
    for name, engine in ENGINES.items():
        then, now = release.environment.get(name), _version(name)
        if then not in (None, now):
            goldens = sorted(release.goldens)
            such = f", such as {goldens[0]}" if goldens else ""
            lines.append(
                f"{engine} {then} at release {release.number}, {now} here: "
                f"{counted(len(goldens), 'golden')} not proven with it{such}"
            )
    return lines


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"
