"""The loss matrix of a conversion, for a correct conversion and for ones with an injected fault."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from asset_robots import ARM, CORNERS, write_arm

from pytest_twin.asset.loss import (
    behaviour,
    compare,
    from_mujoco,
    from_pinocchio,
    from_urdf,
    render,
)
from pytest_twin.asset.loss.description import Description
from pytest_twin.asset.loss.matrix import Conversion, Matrix, Row
from pytest_twin.asset.realize import realize
from pytest_twin.realization import urdf, urdf_extras


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with all converted forms of the arm."""
    folder = tmp_path_factory.mktemp("arm")
    out = folder / "out"
    out.mkdir()
    report = realize(str(write_arm(folder)), str(out))
    assert report["critical"] == []
    return out


@pytest.fixture(scope="module")
def source(made: Path) -> Description:
    robot = urdf.read(made.parent / "arm_description/urdf/arm.urdf")
    points = {"package://arm_description/meshes/part.stl": 1000.0 * CORNERS}
    return from_urdf.describe(robot, urdf_extras.read(robot), points)


def converted(source: Description, made: Path, text: str) -> Conversion:
    """The comparison of the source with an MJCF of this text."""
    path = made / "mutant.xml"
    path.write_text(text)
    target = from_mujoco.describe(mujoco.MjModel.from_xml_path(str(path)), "base")
    robot = urdf.read(made / "arm.urdf")
    return compare.compare(source, target, from_pinocchio.reference(robot), "Pinocchio")


def row(conversion: Conversion, feature: str) -> Row:
    return next(row for row in conversion.rows if row.feature == feature)


def test_the_matrix_of_the_arm_lists_what_is_kept_changed_and_lost(
    source: Description, made: Path
) -> None:
    found = converted(source, made, (made / "arm.xml").read_text())
    verdicts = {row.feature: row.verdict for row in found.rows}
    assert verdicts == {
        "forward kinematics, position": "kept",
        "forward kinematics, orientation": "kept",
        "direction of every joint": "kept",
        "mass": "kept",
        "centre of mass": "kept",
        "gravity torque": "kept",
        "mass matrix": "kept",
        "default state": "kept",
        "links": "kept",
        "joints that move": "kept",
        "independent degrees of freedom": "kept",
        "passive joints": "none",
        "actuators": "kept",
        "position limits": "kept",
        "velocity limits": "lost",
        "effort limits": "lost",
        "damping and friction": "kept",
        "drives": "none",
        "mimic": "kept",
        "tendons and constraints": "none",
        "collision shapes": "changed",
        "disabled pairs": "changed",
        "contact materials": "lost",
        "sensors": "changed",
        "frames": "kept",
        "custom tags": "lost",
        "transmissions": "changed",
        "safety controllers": "lost",
        "controller interfaces": "lost",
    }
    assert not any(row.critical for row in found.rows)
    hull = row(found, "collision shapes").items
    assert [(item.name, item.verdict) for item in hull] == [("upper", "changed")]
    assert hull[0].before.startswith("mesh, 0.2 x 0.1 x 0.05 m around 0.1 0.05 0.125")
    assert hull[0].after.startswith("convex hull, 0.2 x 0.1 x 0.05 m around 0.1 0.05 0.125")
    assert [item.name for item in row(found, "effort limits").items] == ["right"]
    sensors = row(found, "sensors").items
    assert [(item.name, item.after) for item in sensors] == [
        ("eye", "a site: the frame without a signal")
    ]
    reduction = row(found, "transmissions").items[0]
    assert (reduction.name, reduction.after) == ("lift", "reduction 1")
    assert "reduction 50" in reduction.before


def test_sensors_and_frames_have_the_poses_of_the_urdf(made: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(made / "arm.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    imu, body = model.site("wrist_imu"), model.body("upper")
    assert model.site_bodyid[imu.id] == body.id
    assert imu.pos == pytest.approx([0, 0, 0.1])
    turn = data.xmat[body.id].reshape(3, 3).T @ data.site_xmat[imu.id].reshape(3, 3)
    assert turn == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), abs=1e-9)
    assert {model.sensor(i).name for i in range(model.nsensor)} == {
        "wrist_imu_accelerometer",
        "wrist_imu_gyro",
    }
    assert data.site_xpos[model.site("tcp").id] == pytest.approx(data.xpos[model.body("tcp").id])


def test_visual_geoms_have_no_contact_and_no_mass(made: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(made / "arm.xml"))
    seen = model.geom("upper_visual_0")
    assert (seen.contype, seen.conaffinity, seen.group) == (0, 0, 2)
    mesh = int(seen.dataid[0])
    points = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
    assert np.ptp(points @ _axes(seen.quat).T, axis=0) == pytest.approx([0.2, 0.1, 0.05], abs=1e-6)
    assert model.body("upper").mass == 1.5


def _axes(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


FAULTS = {
    "a sign flip": (r'(name="lift"[^>]* axis=")0 ', r"\g<1>0 -", "direction of every joint"),
    "a swapped axis": (
        r'name="extend"',
        'name="extend" axis="1 0 0"',
        "direction of every joint",
    ),
    "a millimetre scale": (
        r'name="slider" pos="0 0 0.3"',
        'name="slider" pos="0 0 300"',
        "forward kinematics, position",
    ),
    "a rotated frame": (
        r'name="left" pos',
        'name="left" euler="0.001 0 0" pos',
        "forward kinematics, orientation",
    ),
    "a shifted centre of mass": (
        r'(<body name="slider".*?<inertial pos=")0 0 0"',
        r'\g<1>0 0.01 0"',
        "centre of mass",
    ),
    "a heavier link": (r'mass="0.4"', 'mass="0.41"', "mass"),
    "a changed inertia": (r'(mass="0.4" diaginertia=")0.001', r"\g<1>0.0015", "links"),
    "armature": (r'name="lift"', 'name="lift" armature="0.01"', "mass matrix"),
    "a dropped mimic": (r"<equality>.*</equality>", "", "mimic"),
    "a reversed mimic ratio": (r'polycoef="0.1 -0.5', 'polycoef="0.1 0.5', "mimic"),
    "a lost range": (
        r'(name="lift"[^>]*) limited="true"',
        r'\1 limited="false"',
        "position limits",
    ),
    "a range in degrees": (r'(name="lift"[^>]*range=")-1.5 2', r"\g<1>-86 115", "position limits"),
    "a weaker actuator": (r'forcerange="-40 40"', 'forcerange="-4 4"', "effort limits"),
    "a lost actuator": (r'<general name="lift"[^>]*/>', "", "actuators"),
    "lost damping": (r' damping="0.4"', "", "damping and friction"),
    "a lost shape": (r'<geom name="left_[^>]*/>', "", "collision shapes"),
    "a mesh in millimetres": (
        r'(<mesh name="part")',
        r'\1 scale="1000 1000 1000"',
        "collision shapes",
    ),
    "a lost sensor": (r"<sensor>.*</sensor>", "", "sensors"),
    "a servo": (r'(<general name="lift")', r'\1 biastype="affine" biasprm="0 -5 0"', "drives"),
    "a joint reference offset": (r'name="lift"', 'name="lift" ref="0.1"', "default state"),
}
CRITICAL = {
    "a sign flip",
    "a swapped axis",
    "a millimetre scale",
    "a rotated frame",
    "a shifted centre of mass",
    "a heavier link",
    "armature",
    "a changed inertia",
    "a reversed mimic ratio",
    "a joint reference offset",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_injected_fault_changes_the_row_of_its_feature(
    source: Description, made: Path, fault: str
) -> None:
    pattern, replacement, feature = FAULTS[fault]
    whole = (made / "arm.xml").read_text()
    text, count = re.subn(pattern, replacement, whole, count=1, flags=re.DOTALL)
    assert count == 1
    assert text != whole
    before, after = (converted(source, made, words) for words in (whole, text))
    assert row(after, feature) != row(before, feature)
    assert row(after, feature).verdict in ("changed", "lost")
    assert any(row.critical for row in after.rows) == (fault in CRITICAL)


def test_the_matrices_of_usd_and_pinocchio_list_what_is_kept_and_lost(made: Path) -> None:
    pytest.importorskip("urdf_usd_converter")
    import json

    matrix = json.loads((made / "loss.json").read_text())
    usd, pinocchio = matrix["conversions"][1:]
    assert [usd["target"], pinocchio["target"]] == ["USD", "Pinocchio"]
    rows = {row["feature"]: row for row in usd["rows"]}
    # The axis of `lift` is oblique, and UsdPhysics stores it in single precision.
    assert rows["forward kinematics, position"]["difference"] < 1e-9
    assert rows["forward kinematics, orientation"]["difference"] < 1e-9
    assert rows["mass"]["verdict"] == "changed"
    assert not any(row["critical"] for row in usd["rows"])
    assert rows["mimic"]["verdict"] == "kept"
    # The follower of a mimic has no drive.
    assert [item["name"] for item in rows["effort limits"]["items"]] == ["right"]
    assert rows["actuators"]["verdict"] == "kept"
    rows = {row["feature"]: row for row in pinocchio["rows"]}
    assert rows["position limits"]["verdict"] == "kept"
    assert rows["mimic"]["verdict"] == "lost"
    assert rows["mimic"]["items"][0]["before"] == "-0.5 * left + 0.1"


def test_reports_escape_names_and_load_no_external_content(made: Path) -> None:
    evil = "<script>alert(1)</script>|`x`"
    item = Row("links", "lost", evil, evil, evil, critical=True)
    matrix = Matrix(evil, evil, (Conversion(evil, evil, evil, (item,)),))
    assert "<script>" not in render.html(matrix)
    assert "<script>" not in render.markdown(matrix).replace("\\<script\\>", "")
    page = (made / "loss.html").read_text()
    assert "src=" not in page
    assert "http" not in page
    assert ARM.splitlines()[0][13:16] in page


class Pendulum:
    """Dynamics of a robot with one joint and constant quantities."""

    joints, frames = ("elbow",), ("tool",)

    def __init__(self, torque: float) -> None:
        self.torque = torque

    def poses(self, q: Mapping[str, float]) -> dict[str, np.ndarray]:
        return {"tool": np.eye(4)}

    def mass(self) -> float:
        return 1.0

    def center_of_mass(self, q: Mapping[str, float]) -> np.ndarray:
        return np.zeros(3)

    def gravity_torque(self, q: Mapping[str, float]) -> np.ndarray:
        return np.array([self.torque])

    def mass_matrix(self, q: Mapping[str, float]) -> np.ndarray:
        return np.eye(1)


def test_a_torque_that_is_no_number_is_a_critical_difference() -> None:
    converted = SimpleNamespace(joints={}, engine="engine", dynamics=Pendulum(np.nan))
    poses = [{"elbow": 0.0}, {"elbow": 1.0}]
    found = behaviour.rows(converted, converted, Pendulum(0.5), "reference", poses)  # type: ignore[arg-type]
    critical = [row.feature for row in found if row.critical]
    assert critical == ["gravity torque"]
