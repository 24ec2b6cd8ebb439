from __future__ import annotations

from pathlib import Path

import fr3
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.chain import ChainParameters, forward, link_parameters
from pytest_twin.calibration.transform_derivatives import inverse_left_jacobian, left_jacobian
from pytest_twin.errors import TwinError
from pytest_twin.metrics.pose import rigid
from pytest_twin.realization.serial_chain import SerialChain, load_serial_chain

SLIDING = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/><link name="tip"/>
<joint name="lift" type="prismatic"><origin xyz="0.1 0 0.2" rpy="0.1 0.2 0.3"/><parent link="base"/>
<child link="a"/><axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>
<joint name="turn" type="continuous"><origin xyz="0.3 0.1 0" rpy="1 0 0"/><parent link="a"/>
<child link="b"/><axis xyz="0.6 0.8 0"/></joint>
<joint name="end" type="fixed"><origin xyz="0 0 0.4" rpy="0 1 0"/><parent link="b"/>
<child link="tip"/></joint></robot>"""


def write_robot(folder: Path, text: str) -> Path:
    path = folder / "robot.urdf"
    path.write_text(text)
    return path


def poses(chain: SerialChain, readings: np.ndarray) -> np.ndarray:
    count = len(chain.joints)
    found = forward(chain, readings, ChainParameters(0, np.zeros(count), (-1,) * count))
    return np.array([rigid(r, p) for r, p in zip(found.rotation, found.position, strict=True)])


@pytest.mark.parametrize(
    ("text", "frame"), [(fr3.urdf(), "fr3_link8"), (SLIDING, "tip")], ids=["fr3", "sliding"]
)
def test_forward_kinematics_and_joint_derivatives_agree_with_pinocchio(
    tmp_path: Path, text: str, frame: str
) -> None:
    chain = load_serial_chain(write_robot(tmp_path, text), frame)
    count = len(chain.joints)
    readings = np.random.default_rng(0).uniform(-1, 1, (5, count))
    parameters = ChainParameters(count, np.zeros(count), tuple(range(count)))
    found = forward(chain, readings, parameters)
    model = pin.buildModelFromXML(text)
    data = model.createData()
    at = model.getFrameId(frame)
    for row, values in enumerate(readings):
        q = pin.integrate(model, pin.neutral(model), values)
        jacobian = pin.computeFrameJacobian(model, data, q, at, pin.LOCAL_WORLD_ALIGNED)
        pin.framesForwardKinematics(model, data, q)
        np.testing.assert_allclose(found.position[row], data.oMf[at].translation, atol=1e-12)
        np.testing.assert_allclose(found.rotation[row], data.oMf[at].rotation, atol=1e-12)
        np.testing.assert_allclose(found.shift[row], jacobian[:3], atol=1e-12)
        np.testing.assert_allclose(found.turn[row], jacobian[3:], atol=1e-12)


def test_the_chain_of_an_mjcf_agrees_with_mujoco(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(
        """<mujoco><compiler angle="radian"/><worldbody><body name="a" pos="0.1 0 0.2">
        <joint name="lift" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="1"
        diaginertia="1 1 1"/><body name="b" pos="0.3 0.1 0" euler="1 0 0">
        <joint name="turn" axis="0.6 0.8 0" pos="0 0 0.1" ref="0.4"/><inertial pos="0 0 0" mass="1"
        diaginertia="1 1 1"/><site name="tip" pos="0 0 0.4"/></body></body></worldbody></mujoco>"""
    )
    import mujoco

    chain = load_serial_chain(path, "tip")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    readings = np.random.default_rng(0).uniform(-1, 1, (4, 2))
    for values, found in zip(readings, poses(chain, readings), strict=True):
        data.qpos[:] = values
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(found[:3, 3], data.site_xpos[0], atol=1e-12)
        np.testing.assert_allclose(found[:3, :3].ravel(), data.site_xmat[0], atol=1e-12)


def test_derivatives_by_link_geometry_agree_with_finite_differences(tmp_path: Path) -> None:
    chain = load_serial_chain(write_robot(tmp_path, fr3.urdf()), "fr3_link8")
    links = link_parameters(chain, 0)
    count = len(chain.joints)
    readings = np.random.default_rng(1).uniform(-1, 1, (3, count))
    values = np.random.default_rng(2).normal(0.0, 0.02, len(links))

    def at(step: np.ndarray):
        columns = tuple(range(len(links)))
        return forward(
            chain,
            readings,
            ChainParameters(
                len(links), np.zeros(count), (-1,) * count, links, values + step, columns
            ),
        )

    found = at(np.zeros(len(links)))
    for column in range(len(links)):
        step = np.zeros(len(links))
        step[column] = 1e-6
        ahead, behind = at(step), at(-step)
        shift = (ahead.position - behind.position) / 2e-6
        np.testing.assert_allclose(found.shift[:, :, column], shift, atol=1e-8)
        turn = Rotation.from_matrix(ahead.rotation @ np.swapaxes(behind.rotation, 1, 2))
        np.testing.assert_allclose(found.turn[:, :, column], turn.as_rotvec() / 2e-6, atol=1e-7)


def test_a_revolute_joint_has_three_geometry_parameters_besides_its_zero(tmp_path: Path) -> None:
    chain = load_serial_chain(write_robot(tmp_path, fr3.urdf()), "fr3_link8")
    links = link_parameters(chain, 1)
    assert [link.label for link in links[:3]] == [
        "offset along x of fr3_joint2",
        "offset along y of fr3_joint2",
        "tilt about x of fr3_joint2",
    ]
    assert len(links) == 3 * 6


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 3.0])
def test_the_left_jacobian_of_rotations_agrees_with_composition(size: float) -> None:
    vector = np.array([0.6, -0.64, 0.48]) * size
    step = np.array([1.0, 2.0, -1.0]) * 1e-6
    ahead = Rotation.from_rotvec(vector + step) * Rotation.from_rotvec(vector).inv()
    np.testing.assert_allclose(left_jacobian(vector) @ step, ahead.as_rotvec(), atol=1e-11)
    both = left_jacobian(vector) @ inverse_left_jacobian(vector)
    np.testing.assert_allclose(both, np.eye(3), atol=1e-6)


def test_an_unknown_frame_is_refused_with_the_most_similar_name(tmp_path: Path) -> None:
    path = write_robot(tmp_path, fr3.urdf())
    with pytest.raises(TwinError, match="no frame 'fr3_link9'") as error:
        load_serial_chain(path, "fr3_link9")
    assert "fr3_link8" in str(error.value)
