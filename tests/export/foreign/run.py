"""Install the simulators of ``pytest-twin export`` in own environments, and run their tests.

    python tests/export/foreign/run.py FOLDER

Each environment is made once in FOLDER, with uv: together 2.5 GB. Of Isaac Lab only the wheels are
fetched, whose classes of actuators are compared: it runs with Isaac Sim or with a GPU.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PACKAGES = {
    "TWIN_MJLAB_PYTHON": ("mjlab==1.6.0",),
    "TWIN_DRAKE_PYTHON": ("drake==1.51.1",),
    "TWIN_MJX_PYTHON": ("mujoco-mjx==3.17.0", "jax"),
    "TWIN_NEWTON_PYTHON": ("newton[sim]==1.8.0", "newton-usd-schemas==0.6.0", "usd-core"),
}
"""Environment variable of the tests -> packages of its environment."""

folder = Path(sys.argv[1]).resolve()
environment = dict(os.environ)
for variable, packages in PACKAGES.items():
    place = folder / variable.lower()
    python = place / "bin" / "python"
    if not python.is_file():
        subprocess.run(["uv", "venv", "--python", "3.11", str(place)], check=True)
        subprocess.run(["uv", "pip", "install", "--python", str(python), *packages], check=True)
    environment[variable] = str(python)
wheels = folder / "isaaclab"
for version, python in (("2.3.2.post1", "3.11"), ("3.0.0", "3.12")):
    if not list(wheels.glob(f"isaaclab-{version}-*")):
        subprocess.run(
            [
                sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:",
                "--python-version", python, "--dest", str(wheels), f"isaaclab=={version}",
            ],
            check=True,
        )  # fmt: skip
environment["TWIN_ISAACLAB_WHEELS"] = os.pathsep.join(map(str, wheels.glob("*.whl")))
tests = Path(__file__).parents[1]
sys.exit(subprocess.run([sys.executable, "-m", "pytest", str(tests)], env=environment).returncode)
