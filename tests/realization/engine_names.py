"""Write ``engine_names.json``: names of the newest MuJoCo that the older supported ones lack.

python tests/realization/engine_names.py        # installs each version into a cache, with uv
"""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

NEWEST, OLDER = "4.0.0", ("3.11.0", "3.17.0")
FILE = Path(__file__).with_name("engine_names.json")
_MODULES = ("rollout", "batch")


def names() -> set[str]:
    """``function``, ``Class.attribute`` and ``module.name`` of the MuJoCo of this process."""
    import mujoco

    found = set()
    for prefix, space in [("", mujoco), *((f"{m}.", _module(m)) for m in _MODULES)]:
        # The class of a context depends on MUJOCO_GL.
        for name in (n for n in dir(space) if not n.startswith("_") and n != "GLContext"):
            found.add(prefix + name)
            if isinstance(member := getattr(space, name), type):
                found |= {f"{prefix}{name}.{n}" for n in dir(member) if not n.startswith("_")}
    return found


def _module(name: str) -> object:
    try:
        return importlib.import_module(f"mujoco.{name}")
    except ImportError:
        return None


def _names_of(version: str) -> set[str]:
    command = [
        "uv",
        "run",
        "--isolated",
        "--no-project",
        "--with",
        f"mujoco=={version}",
        "python",
        __file__,
    ]
    output = subprocess.run([*command, "list"], check=True, capture_output=True, text=True).stdout
    return set(json.loads(output))


if __name__ == "__main__":
    if sys.argv[1:] == ["list"]:
        print(json.dumps(sorted(names())))
    else:
        newest = _names_of(NEWEST)
        lacking = {version: sorted(newest - _names_of(version)) for version in OLDER}
        FILE.write_text(json.dumps(lacking, indent=1) + "\n")
