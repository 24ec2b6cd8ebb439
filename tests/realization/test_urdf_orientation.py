"""Quaternions of a URDF 1.1 or 1.2: every form of the robot has the same rotation."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pytest_twin.asset.realize import realize
from pytest_twin.audit.audit_file import audit_file
from pytest_twin.cli import main
from pytest_twin.errors import ModelError
from pytest_twin.realization import load, urdf

INERTIA = '<inertia ixx="0.002" iyy="0.01" izz="0.011" ixy="0" ixz="0" iyz="0"/>'
LINK = (
    '<link name="{name}"><inertial><origin xyz="0.1 0 0" {inertial}/><mass value="1"/>'
    + INERTIA
    + '</inertial><visual><origin xyz="0.1 0 0" {visual}/><geometry>'
    '<box size="0.2 0.05 0.03"/></geometry></visual><collision><origin xyz="0.1 0 0" {collision}/>'
    '<geometry><box size="0.2 0.05 0.03"/></geometry></collision></link>\n'
)
ROBOT = """<robot name="arm" {version}>
{links}<joint name="j1" type="revolute"><origin xyz="0.2 0 0"/><parent link="base"/>
<child link="l1"/><axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5" effort="10" velocity="2"/></joint>
<joint name="j2" type="revolute"><origin xyz="0.5 0 0" {joint}/><parent link="l1"/>
<child link="l2"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="10" velocity="2" acceleration="5" jerk="50"/></joint>
</robot>
"""  # noqa: E501
TURN = 'quat_xyzw="0 0 0.3826834323650898 0.9238795325112867"'
"""45 degrees about z."""
PLACES = ("joint", "inertial", "visual", "collision")


def arm(folder: Path, *, version: str = 'version="1.2"', **origins: str) -> Path:
    words = dict.fromkeys(PLACES, "") | origins
    plain = dict.fromkeys(PLACES, "")
    links = (
        LINK.format(name="base", **plain)
        + LINK.format(name="l1", **plain)
        + LINK.format(name="l2", **words)
    )
    path = folder / "arm.urdf"
    path.write_text(ROBOT.format(version=version, links=links, joint=words["joint"]))
    return path


def rotations() -> st.SearchStrategy[Rotation]:
    part = st.floats(-1, 1, allow_subnormal=False)
    anything = st.tuples(part, part, part, part).filter(lambda q: np.linalg.norm(q) > 0.1)
    angle = st.floats(-3.2, 3.2)
    # At a pitch of 90 degrees roll and yaw are one angle.
    locked = st.tuples(angle, st.sampled_from([np.pi / 2, -np.pi / 2]), angle)
    return st.one_of(
        anything.map(Rotation.from_quat), locked.map(lambda rpy: Rotation.from_euler("xyz", rpy))
    )


@settings(max_examples=60, deadline=None)
@given(rotations())
def test_every_reader_has_the_rotation_of_the_quaternion(
    tmp_path_factory: pytest.TempPathFactory, rotation: Rotation
) -> None:
    text = " ".join(repr(float(part)) for part in rotation.as_quat())
    path = arm(tmp_path_factory.mktemp("arm"), **dict.fromkeys(PLACES, f'quat_xyzw="{text}"'))

    robot = urdf.read(path)
    model = load(path).model
    pinocchio = pin.buildModelFromUrdf(str(path))  # urdfdom reads the quaternion itself

    expected = rotation.as_matrix()
    np.testing.assert_allclose(robot.joints["j2"].rotation, expected, atol=1e-12)
    np.testing.assert_allclose(pinocchio.jointPlacements[2].rotation, expected, atol=1e-9)
    np.testing.assert_allclose(pinocchio.inertias[2].inertia, robot.links["l2"].inertia, atol=1e-12)
    body = model.body("l2")
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, body.quat)
    np.testing.assert_allclose(matrix.reshape(3, 3), expected, atol=1e-12)
    mujoco.mju_quat2Mat(matrix, body.iquat)
    axes = matrix.reshape(3, 3)
    np.testing.assert_allclose(
        axes @ np.diag(body.inertia) @ axes.T, robot.links["l2"].inertia, atol=1e-9
    )
    geom = model.geom(model.body("l2").geomadr[0])
    mujoco.mju_quat2Mat(matrix, geom.quat)
    np.testing.assert_allclose(matrix.reshape(3, 3), expected, atol=1e-12)


@pytest.mark.parametrize("version", ['version="1.1"', 'version="1.2"'])
@pytest.mark.parametrize("place", PLACES)
def test_realize_states_the_rotation_as_rpy_in_every_form(
    tmp_path: Path, version: str, place: str
) -> None:
    source = arm(tmp_path, version=version, **{place: TURN})
    out = tmp_path / "out"
    out.mkdir()

    made = realize(str(source), str(out))

    assert made["critical"] == []
    assert "quat_xyzw" not in (out / "arm.urdf").read_text()
    changed = json.loads((out / "changes.json").read_text())["changes"]
    assert any("quat_xyzw" in change["where"] for change in changed)
    rows = json.loads((out / "loss.json").read_text())["conversions"]
    assert not any("quat_xyzw" in json.dumps(conversion) for conversion in rows)
    normalized = urdf.read(out / "arm.urdf")
    read = urdf.read(source)
    for name, joint in read.joints.items():
        np.testing.assert_allclose(normalized.joints[name].rotation, joint.rotation, atol=1e-12)
    for name, link in read.links.items():
        np.testing.assert_allclose(normalized.links[name].inertia, link.inertia, atol=1e-12)
    assert not [
        finding
        for finding in audit_file(str(source))["findings"]
        if finding["code"].startswith("frames.quaternion")
    ]


@pytest.mark.parametrize("version", ["", 'version="1.0"', 'version="one"'])
def test_a_quaternion_without_the_version_is_ignored_with_a_note(
    tmp_path: Path, version: str
) -> None:
    path = arm(tmp_path, version=version, joint=TURN)

    realization = load(path)

    np.testing.assert_array_equal(urdf.read(path).joints["j2"].rotation, np.eye(3))
    assert any("quat_xyzw is ignored" in note for note in realization.notes)
    codes = [finding["code"] for finding in audit_file(str(path))["findings"]]
    assert "frames.quaternion" in codes


@pytest.mark.parametrize(
    ("origin", "problem"),
    [
        (f'rpy="0 0 0" {TURN}', "two orientations of one origin, rpy and quat_xyzw"),
        ('quat_xyzw="0 0 0 0"', "no quaternion of a rotation"),
        ('quat_xyzw="0 0 1 1"', "no quaternion of a rotation"),
        ('quat_xyzw="0 0 1"', "another count of numbers"),
    ],
)
def test_an_origin_without_one_rotation_is_refused_with_line_and_joint(
    tmp_path: Path, origin: str, problem: str
) -> None:
    path = arm(tmp_path, joint=origin)

    with pytest.raises(ModelError) as caught:
        load(path)

    assert caught.value.problem == problem
    assert caught.value.where is not None
    assert "joint 'j2'" in caught.value.where
    assert (
        caught.value.line
        == path.read_text()
        .splitlines()
        .index(next(line for line in path.read_text().splitlines() if 'name="j2"' in line))
        + 1
    )


@pytest.mark.usefixtures("commands_in_process")
def test_no_golden_of_a_robot_with_quaternions_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = arm(tmp_path, **dict.fromkeys(PLACES, TURN))

    status = main(["init", str(robot), "--out", str(tmp_path / "twin")])

    summary = json.loads((tmp_path / "twin" / ".twin" / "init.json").read_text())
    assert status == 0, capsys.readouterr().err
    assert summary["failing"] == {}
    assert summary["left_out"] == {}
