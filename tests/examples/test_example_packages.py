"""The packages in ``examples/`` are installed by pip and used through the commands and pytest."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.formats.recordings import read_one

pytest.importorskip("hatchling", reason="the extra 'test' is not installed")

EXAMPLES = Path(__file__).parents[2] / "examples"
PACKAGES = sorted(path.parent for path in EXAMPLES.glob("*/pyproject.toml"))
FORE = 0.25
"""Length of the forearm, m."""

ARM = f"""\
<mujoco model="arm">
  <worldbody>
    <body name="upper">
      <joint name="pan" axis="0 0 1"/>
      <inertial pos="0.3 0 0.2" mass="1.2" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="fore" pos="0.3 0 0.2">
        <joint name="elbow" axis="0 1 0"/>
        <inertial pos="{FORE} 0 0" mass="0.6" diaginertia="1e-3 1e-3 1e-3"/>
        <site name="flange" pos="{FORE} 0 0"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
TABLE = f"""\
joint,a,alpha,d,mass
pan,0.3,-90,0.2,1.2
elbow,{FORE},90,0,0.6
"""
TWIN = """\
name: arm
realizations:
  mujoco: {file: arm.xml}
  data_sheet: {file: arm.dh}
"""
FK = """\
schema: 1
kind: fk
realizations: [mujoco, data_sheet]
target: {frames: [flange]}
stimulus: {poses: [{name: bent, joints: {pan: 30 deg, elbow: 40 deg}}]}
tolerance: {position: 0.1 mm, orientation: 0.1 mrad}
"""
MANIPULABILITY = """\
schema: 1
kind: manipulability
target: {site: flange}
tolerance: {singular_value: 1 mm}
"""
URDF = """\
<robot name="fast">
  <link name="base"/>
  <link name="arm">
    <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="10" velocity="VELOCITY"/>
  </joint>
</robot>
"""


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder into which pip has installed all examples."""
    folder = tmp_path_factory.mktemp("examples")
    copies = [shutil.copytree(path, folder / "source" / path.name) for path in PACKAGES]
    site = folder / "site"
    options = ["--quiet", "--no-deps", "--no-index", "--no-build-isolation", "--no-compile"]
    command = [sys.executable, "-m", "pip", "install", "--disable-pip-version-check", *options]
    subprocess.run([*command, "--target", str(site), *map(str, copies)], check=True, timeout=120)
    return site


class Shell:
    """Runs commands in an environment in which the examples are installed."""

    def __init__(self, site: Path, folder: Path) -> None:
        self.site, self.folder = site, folder

    def write(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        names = ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CACHE_HOME")
        home = dict.fromkeys(names, str(self.folder.parent / "home"))
        return subprocess.run(
            command,
            cwd=self.folder,
            env={**os.environ, **home, "PYTHONPATH": str(self.site)},
            capture_output=True,
            text=True,
            timeout=120,
        )

    def twin(self, *words: str) -> subprocess.CompletedProcess[str]:
        return self.run(str(Path(sys.executable).with_name("pytest-twin")), *words)

    def pytest(self, *words: str) -> subprocess.CompletedProcess[str]:
        return self.run(sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *words)


@pytest.fixture
def shell(packages: Path, tmp_path: Path) -> Shell:
    site = shutil.copytree(packages, tmp_path / "site")
    (tmp_path / "work").mkdir()
    return Shell(site, tmp_path / "work")


@pytest.fixture
def arm(shell: Shell) -> Shell:
    """A twin with a model, a data sheet and two goldens that are not recorded yet."""
    for name, text in (
        ("arm.xml", ARM),
        ("arm.dh", TABLE),
        ("twin.yaml", TWIN),
        ("golden/fk.yaml", FK),
        ("golden/manipulability.yaml", MANIPULABILITY),
    ):
        shell.write(name, text)
    return shell


def test_a_golden_kind_and_a_model_format_of_packages_can_be_released_and_are_tested_after_changes(
    arm: Shell,
) -> None:
    recorded = arm.pytest("--twin-update")
    assert recorded.returncode == 0, recorded.stdout + recorded.stderr
    # The smallest value is the lever of the elbow: the length of the forearm.
    spec = (arm.folder / "golden" / "manipulability.yaml").read_text()
    smallest = next(float(line.split(":")[1]) for line in spec.splitlines() if "smallest:" in line)
    assert smallest == pytest.approx(FORE, abs=1e-9)
    released = arm.pytest("--twin-release")
    assert released.returncode == 0, released.stdout + released.stderr
    assert "4 passed" in released.stdout

    # Forward kinematics depend on a length and not on a mass, here only in the data sheet.
    arm.write("arm.dh", TABLE.replace("0.2,1.2", "0.2,1.3"))
    assert "4 deselected" in arm.pytest("--twin-release").stdout
    arm.write("arm.dh", TABLE.replace("pan,0.3", "pan,0.31"))
    changed = arm.pytest("--twin-release")
    assert "1 failed, 3 deselected" in changed.stdout
    assert "golden/fk.yaml::fk[data_sheet]" in changed.stdout
    assert "10 mm" in changed.stdout or "0.01 m" in changed.stdout


def test_after_an_update_of_a_model_format_package_its_goldens_run_again(arm: Shell) -> None:
    assert arm.pytest("--twin-update").returncode == 0
    assert arm.pytest("--twin-release").returncode == 0
    (info,) = arm.site.glob("twin_dh_table-*.dist-info")
    info.rename(info.with_name("twin_dh_table-1.1.dist-info"))
    metadata = arm.site / "twin_dh_table-1.1.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("Version: 1.0", "Version: 1.1"))
    module = arm.site / "dh_table.py"
    module.write_text(module.read_text().replace("{row['a']} 0", "0 {row['a']}"))
    assert "1 failed, 3 deselected" in arm.pytest("--twin-release").stdout


def test_a_model_that_a_package_cannot_read_fails_without_traceback(arm: Shell) -> None:
    assert arm.pytest("--twin-update").returncode == 0
    arm.write("arm.dh", "a,b\n1,2\n")
    failed = arm.pytest("-k", "data_sheet")
    assert failed.returncode != 0
    said = failed.stdout + failed.stderr
    assert "arm.dh: package 'twin-dh-table' 1.0 cannot read it: KeyError: 'joint'" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(("velocity", "warnings"), [("3.5", 1), ("2.5", 0)])
def test_findings_of_an_audit_layer_from_a_package_are_reported(
    shell: Shell, velocity: str, warnings: int
) -> None:
    shell.write("fast.urdf", URDF.replace("VELOCITY", velocity))
    done = shell.twin("audit", "fast.urdf", "--json", "audit.json", "--out", "out")
    audit = json.loads((shell.folder / "audit.json").read_text())
    assert audit["layers"]["cell_speed"]["warning"] == warnings, done.stderr
    found = [f for f in audit["findings"] if f["layer"] == "cell_speed"]
    assert [(f["element"], f["value"], f["unit"], f["line"]) for f in found] == [
        ("joint 'turn'", 3.5, "rad/s", 6)
    ] * warnings
    assert ("velocity limit is above that of the cell" in done.stdout) == bool(warnings)
    (page,) = (shell.folder / "out").glob("*.html")
    assert "Cell speed" in page.read_text()


@pytest.mark.parametrize(
    ("written", "instead", "told"),
    [
        ("cell_speed.too_fast", "tree.too_fast", "expected a code cell_speed.WHAT"),
        ("asset.joints", "asset.motors", "fails: AttributeError"),
        ("class CellSpeed", "class Speed", "cannot be loaded: AttributeError"),
    ],
)
def test_an_unusable_audit_layer_of_a_package_is_refused_without_traceback(
    shell: Shell, written: str, instead: str, told: str
) -> None:
    module = shell.site / "cell_speed.py"
    assert written in module.read_text()
    module.write_text(module.read_text().replace(written, instead))
    shell.write("fast.urdf", URDF.replace("VELOCITY", "3.5"))
    done = shell.twin("audit", "fast.urdf", "--out", "out")
    assert done.returncode == 2
    assert "package 'twin-cell-speed' 1.0" in done.stderr
    assert told in done.stderr
    assert "Traceback" not in done.stderr


def test_a_recording_reader_of_a_package_reads_the_log_of_a_robot(shell: Shell) -> None:
    time = np.arange(50) / 500.0
    columns = {"timestamp": time}
    for scale, name in enumerate(("actual_q", "actual_qd", "target_q", "target_qd"), 1):
        columns |= {f"{name}_{i}": scale * np.sin(time + i) for i in range(6)}
    table = np.column_stack(list(columns.values()))
    np.savetxt(shell.folder / "log.rtde", table, header=" ".join(columns), comments="")
    shown = shell.twin("show", "log.rtde")
    assert shown.returncode == 0, shown.stderr
    assert "shoulder_pan" in shown.stdout
    converted = shell.twin("convert", "log.rtde", "--out", "log.mcap")
    assert converted.returncode == 0, converted.stderr
    found = read_one(shell.folder / "log.mcap").series
    np.testing.assert_allclose(found["state"].velocity[:, 2], columns["actual_qd_2"], atol=1e-12)
    np.testing.assert_allclose(found["command"].position[:, 5], columns["target_q_5"], atol=1e-12)
    np.testing.assert_allclose(np.diff(found["state"].stamp), 2e6, atol=1)


def test_an_effect_of_a_package_is_listed_in_the_catalogue(shell: Shell) -> None:
    listed = shell.twin("effects")
    assert listed.returncode == 0, listed.stderr
    assert "u = (q - pose) / width" in listed.stdout
