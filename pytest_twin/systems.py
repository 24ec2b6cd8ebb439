"""Check of the operating system, and of the MuJoCo that is installed."""

from __future__ import annotations

import platform
import sys
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

OLDEST_MUJOCO = (3, 11)
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


def unusable_mujoco() -> str | None:
    """Why the installed MuJoCo cannot be used, and what to do; None where it can. Imports nothing.

    ``pip install`` of MuJoCo 4 over MuJoCo 3 removes files that both have: the folder stays without
    its compiled modules.
    """
    oldest = ".".join(map(str, OLDEST_MUJOCO))
    spec = find_spec("mujoco")
    installed = _mujoco_version()
    if spec is None or installed is None:
        return f"MuJoCo is not installed: pip install 'mujoco>={oldest}'"
    numbers = tuple(int(part) for part in installed.split(".")[:2] if part.isdigit())
    if numbers < OLDEST_MUJOCO:
        return (
            f"MuJoCo {installed} is installed, and pytest-twin needs {oldest} or newer: "
            f"pip install 'mujoco>={oldest}', in an environment of its own where another package "
            "needs the older version"
        )
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    if any(True for folder in folders for _ in folder.glob("_structs*")):
        return None
    return (
        f"MuJoCo {installed} cannot be imported: an upgrade from MuJoCo 3 to 4 in place leaves it "
        "without its compiled part; uninstall first: pip uninstall -y mujoco mujoco-core "
        "mujoco-studio && pip install mujoco"
    )


def _mujoco_version() -> str | None:
    # Without its renderers, MuJoCo 4 is installed as mujoco-core alone.
    for name in ("mujoco", "mujoco-core"):
        with suppress(PackageNotFoundError):
            return version(name)
    return None
