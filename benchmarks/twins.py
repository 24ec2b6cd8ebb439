"""Write twins with a given number of goldens, for benchmarks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

MODEL = """\
<mujoco model="arm">
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper" pos="0 0 0.2">
      <inertial pos="0.15 0 0" mass="1.2" diaginertia="0.002 0.01 0.01"/>
      <joint name="shoulder" type="hinge" axis="0 1 0" range="-1.5 1.5" damping="0.5"/>
      <body name="fore" pos="0.3 0 0">
        <inertial pos="0.1 0 0" mass="0.6" diaginertia="0.001 0.004 0.004"/>
        <joint name="elbow" type="hinge" axis="0 1 0" range="-2 2" damping="0.2"/>
        <site name="tcp" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

SPEC = """\
schema: 1
kind: fk
title: The tool, bent
target:
  frames: [tcp]
stimulus:
  poses:
    - reference
    - {name: bent, joints: {shoulder: 0.3, elbow: 40 deg}}
tolerance:
  position: 0.1 mm
  orientation: 0.1 mrad
"""


def environment(folder: Path) -> dict[str, str]:
    """Return an environment without signing keys."""
    home = str(folder.parent / "home")
    names = ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME")
    dropped = ("CI", "PYTHONDONTWRITEBYTECODE")
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    return {**kept, **dict.fromkeys(names, home)}


def pytest_command(*arguments: str) -> list[str]:
    """Return the command of pytest with this interpreter."""
    return [sys.executable, "-m", "pytest", *arguments]


def make_twin(folder: Path) -> None:
    """Write a twin with one recorded golden, ``golden/g00000``."""
    (folder / "golden").mkdir(parents=True)
    (folder / "twin.yaml").write_text("name: arm\nmodel: arm.xml\n")
    (folder / "arm.xml").write_text(MODEL)
    (folder / "golden" / "g00000.yaml").write_text(SPEC)
    subprocess.run(
        pytest_command("-q", "--twin-update"),
        cwd=folder,
        env=environment(folder),
        check=True,
        stdout=subprocess.DEVNULL,
    )


def multiply(folder: Path, count: int) -> None:
    """Copy the first golden under other names until there are ``count``."""
    text = (folder / "golden" / "g00000.yaml").read_text()
    for index in range(1, count):
        path = folder / "golden" / f"{index // 100:03d}" / f"g{index:05d}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
