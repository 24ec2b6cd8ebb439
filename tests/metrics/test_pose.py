from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pytest_twin.metrics import pose

directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)


def unit(vector: object) -> np.ndarray:
    return np.asarray(vector) / np.linalg.norm(vector)


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-9, 1e-6, 0.3, 2.0, np.pi - 1e-6, np.pi - 1e-9, np.pi]
)
@given(axis=directions, base=directions)
def test_geodesic_angle_is_exact_for_all_angles(angle: float, axis: tuple, base: tuple) -> None:
    turn = Rotation.from_rotvec(angle * unit(axis)).as_matrix()
    start = Rotation.from_rotvec(np.asarray(base)).as_matrix()
    assert pose.rotation_angle(turn) == pytest.approx(angle, abs=2e-15)
    assert pose.orientation_error(start @ turn, start) == pytest.approx(angle, abs=4e-15)
    assert pose.orientation_error(start, start @ turn) == pytest.approx(angle, abs=4e-15)


@given(st.floats(1e-9, np.pi - 1e-3), directions)
def test_rotation_vector_is_axis_times_angle(angle: float, axis: tuple) -> None:
    vector = pose.rotation_vector(Rotation.from_rotvec(angle * unit(axis)).as_matrix())
    np.testing.assert_allclose(vector, angle * unit(axis), rtol=1e-6, atol=1e-15)


@given(st.floats(0, np.pi), directions)
def test_rotation_matrix_survives_conversion_to_quaternion_and_back(
    angle: float, axis: tuple
) -> None:
    rotation = Rotation.from_rotvec(angle * unit(axis))
    quaternion = pose.quaternion_of(rotation.as_matrix())
    expected = rotation.as_quat(scalar_first=True)
    assert abs(quaternion @ expected) == pytest.approx(1.0, abs=1e-14)
    assert quaternion[0] >= 0.0
    np.testing.assert_allclose(pose.rotation_of(quaternion), rotation.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1.0, np.pi / 2, np.pi - 1e-10, np.pi])
def test_angle_between_directions_is_exact(angle: float) -> None:
    turned = [3 * np.cos(angle), 3 * np.sin(angle), 0.0]
    assert pose.direction_error([0.5, 0, 0], turned) == pytest.approx(angle, abs=1e-15)


def test_angles_of_zero_or_non_finite_vectors_are_nan() -> None:
    assert np.isnan(pose.direction_error([0, 0, 0], [1, 0, 0]))
    assert np.isnan(pose.direction_error([np.nan, 0, 0], [1, 0, 0]))
    broken = np.full((3, 3), np.nan)
    assert np.isnan(pose.rotation_angle(broken))
    assert np.isnan(pose.rotation_vector(broken)).all()
    assert np.isnan(pose.quaternion_of(broken)).all()
    assert np.isnan(pose.position_error([np.nan, 0, 0], [0, 0, 0]))


def test_pose_vector_contains_position_then_quaternion() -> None:
    transform = np.eye(4)
    transform[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    transform[:3, 3] = [1, 2, 3]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(pose.pose_vector(transform), [1, 2, 3, half, 0, 0, half])


def test_many_poses_are_built_from_one_rotation_and_inverted() -> None:
    turn = pose.rotation_of([0.5, 0.5, -0.5, 0.5])
    poses = pose.rigid(turn, np.arange(6.0).reshape(2, 3))
    assert poses.shape == (2, 4, 4)
    assert np.array_equal(poses[:, :3, :3], np.stack([turn, turn]))
    assert pose.inverse(poses) @ poses == pytest.approx(np.stack([np.eye(4)] * 2))
