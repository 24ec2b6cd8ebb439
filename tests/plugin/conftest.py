"""A small twin in a folder of its own, and a pytest that runs in it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

MODEL = """\
<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper" pos="0 0 0.2">
      <inertial pos="0.15 0 0" mass="1.2" diaginertia="0.002 0.01 0.01"/>
      <joint name="shoulder" type="hinge" axis="0 1 0" range="-1.5 1.5" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" contype="0" conaffinity="0"/>
      <body name="fore" pos="0.3 0 0">
        <inertial pos="0.1 0 0" mass="0.6" diaginertia="0.001 0.004 0.004"/>
        <joint name="elbow" type="hinge" axis="0 1 0" range="-2 2" damping="0.2"/>
        <geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" contype="0" conaffinity="0"/>
        <site name="tcp" pos="0.25 0 0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40" ctrlrange="-1.5 1.5"/>
    <position name="elbow" joint="elbow" kp="20" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""

FK = """\
schema: 1
kind: fk
title: The tool at the reference and bent
target:
  frames: [tcp]
stimulus:
  poses:
    - reference
    - name: bent
      joints: {shoulder: 0.3, elbow: 40 deg}
tolerance:
  position: 0.1 mm
  orientation: 0.1 mrad
"""

MASS = """\
schema: 1
kind: mass_properties
title: What the arm weighs
criticality: CRITICALITY
stimulus:
  poses: [reference]
tolerance:
  mass: 1 g
  center_of_mass: 0.1 mm
  gravity_torque: 1 mN*m
"""


class TwinFolder:
    """A twin below pytester's folder, with two goldens: ``fk/home`` and ``mass/arm``."""

    def __init__(self, pytester: pytest.Pytester, root: Path) -> None:
        self.pytester = pytester
        self.root = root
        self.write("twin.yaml", "name: arm\nmodel: arm.xml\ntcp: tcp\n")
        self.write("arm.xml", MODEL)
        self.write("golden/fk/home.yaml", FK)
        self.write("golden/mass/arm.yaml", MASS.replace("CRITICALITY", "critical"))

    def write(self, name: str, text: str) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def edit(self, name: str, old: str, new: str) -> None:
        path = self.root / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def run(self, *arguments: str, env: Sequence[str] = ()) -> pytest.RunResult:
        """pytest in a process of its own, as a user would run it."""
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
        if "--lf" in arguments or "--ff" in arguments:
            command = [sys.executable, "-m", "pytest", *arguments]
        return self.pytester.run(*command, timeout=120)

    def record(self) -> None:
        assert self.run("--twin-update").ret == 0

    def release(self) -> None:
        assert self.run("--twin-release").ret == 0

    @property
    def releases(self) -> list[str]:
        folder = self.root / "releases"
        return sorted(path.name for path in folder.glob("[0-9]*")) if folder.is_dir() else []


@pytest.fixture
def twin(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> TwinFolder:
    """A twin in pytester's own folder; nobody's keys, no CI."""
    home = pytester.path / ".home"
    home.mkdir()
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(home))
    for name in ("CI", "TWIN_SIGNING_KEY", "PYTEST_ADDOPTS"):
        monkeypatch.delenv(name, raising=False)
    return TwinFolder(pytester, pytester.path)
