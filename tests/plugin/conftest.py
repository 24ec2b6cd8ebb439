"""A small twin in a temporary folder, and helpers that run pytest in it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import coal
import h5py
import matplotlib.pyplot
import mujoco
import numpy.fft
import onnx
import pinocchio
import pytest
from in_process import GateInProcess
from securesystemslib.signer import CryptoSigner

# Imported here once: pytester unloads modules imported by an inner run, and extension modules
# such as libyaml's cannot be imported twice.
from pytest_twin.checks import check_of, kinds
from pytest_twin.gate import runner, worker

for _kind in kinds():
    check_of(_kind)
assert CryptoSigner.generate_ed25519().private_bytes
assert coal.CollisionObject
assert matplotlib.pyplot.figure
assert mujoco.MjModel
assert numpy.fft.rfft
assert pinocchio.Model
assert onnx.ModelProto
assert worker.run_golden
assert h5py.File

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

TWIN = """\
name: arm
model: arm.xml
tcp: tcp
retired:
  golden/asset/audit: the audit has its own tests
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


TASK = """\
schema: 1
kind: task
title: A user's own function
criticality: {criticality}
target:
  function: {name}.py:run
  outputs:
    reach: {{unit: m, tolerance: 1 mm}}
"""


class TwinFolder:
    """A twin in ``arm/`` in pytester's folder with two goldens: ``fk/home``, ``mass/arm``."""

    def __init__(self, pytester: pytest.Pytester) -> None:
        self.pytester = pytester
        self.root = pytester.path / "arm"

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

    def task(self, name: str, code: str, criticality: str = "critical") -> None:
        """Write a golden of kind task, ``golden/task/<name>``, whose function has this body."""
        body = "".join(f"    {line}\n" for line in code.splitlines())
        self.write(f"{name}.py", f"def run(realization):\n{body}")
        self.write(f"golden/task/{name}.yaml", TASK.format(name=name, criticality=criticality))

    def run(self, *arguments: str) -> pytest.RunResult:
        """Run pytest in the twin's folder, in this process."""
        return self.pytester.runpytest_inprocess("-p", "no:xdist", *arguments)

    def run_apart(self, *arguments: str) -> pytest.RunResult:
        """Run pytest in the twin's folder in a new process, as a user does."""
        return self.pytester.run(sys.executable, "-m", "pytest", *arguments, timeout=100)

    @property
    def releases(self) -> list[str]:
        folder = self.root / "releases"
        return sorted(path.name for path in folder.glob("[0-9]*")) if folder.is_dir() else []


@pytest.fixture(scope="module")
def gate_in_process() -> Iterator[None]:
    """The gate runs goldens in this process, because the start of its child takes 1 to 2 s.

    The child is tested in modules without this fixture.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "Sandbox", GateInProcess)
        yield


def _environment(monkeypatch: pytest.MonkeyPatch, home: Path) -> None:
    """Use an empty home folder without keys and caches."""
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(home))


@pytest.fixture(scope="session")
def templates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders ``new``, ``recorded`` and ``released``, each with a twin ``arm`` and a ``home``."""
    base = tmp_path_factory.mktemp("twins")
    new = base / "new" / "arm"
    (new / "golden" / "fk").mkdir(parents=True)
    (new / "golden" / "mass").mkdir()
    (base / "new" / "home").mkdir()
    (new / "twin.yaml").write_text(TWIN)
    (new / "arm.xml").write_text(MODEL)
    (new / "golden" / "fk" / "home.yaml").write_text(FK)
    (new / "golden" / "mass" / "arm.yaml").write_text(MASS.replace("CRITICALITY", "critical"))
    with pytest.MonkeyPatch.context() as monkeypatch:
        before = base / "new"
        for name, flag in (("recorded", "--twin-update"), ("released", "--twin-release")):
            after = base / name
            shutil.copytree(before, after)
            _environment(monkeypatch, after / "home")
            result = subprocess.run(
                [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", flag],
                cwd=after / "arm",
                capture_output=True,
                text=True,
                timeout=120,
            )
            assert result.returncode == 0, result.stdout + result.stderr
            before = after
    return base


def _copy(
    name: str, templates: Path, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> TwinFolder:
    shutil.copytree(templates / name, pytester.path, dirs_exist_ok=True)
    _environment(monkeypatch, pytester.path / "home")
    monkeypatch.chdir(pytester.path / "arm")
    return TwinFolder(pytester)


@pytest.fixture
def twin(templates: Path, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> TwinFolder:
    """A twin whose goldens were never recorded."""
    return _copy("new", templates, pytester, monkeypatch)


@pytest.fixture
def recorded(
    templates: Path, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> TwinFolder:
    """A twin with recorded goldens and no release."""
    return _copy("recorded", templates, pytester, monkeypatch)


@pytest.fixture
def released(
    templates: Path, pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> TwinFolder:
    """A twin with release 0001 and nothing stale."""
    return _copy("released", templates, pytester, monkeypatch)
