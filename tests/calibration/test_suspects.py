"""Suspected wrong units, directions and signs are reported with a remedy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cells
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Accept
from pytest_twin.metrics.pose import inverse

Change = Callable[[Observations], Observations]


def scaled(poses: np.ndarray, factor: float) -> np.ndarray:
    found = poses.copy()
    found[:, :3, 3] *= factor
    return found


def sign_changed(poses: np.ndarray, axis: int) -> np.ndarray:
    found = poses.copy()
    found[:, axis, 3] *= -1.0
    return found


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def reordered(poses: np.ndarray) -> np.ndarray:
    """Poses whose x y z w quaternions are read as w x y z."""
    found = poses.copy()
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    found[:, :3, :3] = Rotation.from_quat(np.roll(xyzw, -1, axis=1)).as_matrix()
    return found


CAMERA: dict[str, tuple[Change, str]] = {
    "inverted": (
        lambda o: replace(o, camera_from_target=inverse(o.camera_from_target)),
        "camera_from_target seems to be the camera in the target",
    ),
    "mm": (
        lambda o: replace(o, camera_from_target=scaled(o.camera_from_target, 1000.0)),
        "it seems to be in mm",
    ),
    "size of the target": (
        lambda o: replace(o, camera_from_target=scaled(o.camera_from_target, 1.05)),
        "too large or too small by a factor of 1.0",
    ),
    "order of the quaternion": (
        lambda o: replace(o, camera_from_target=reordered(o.camera_from_target)),
        "the quaternions of camera_from_target seem to be in the order x y z w",
    ),
    "left-handed frame": (
        lambda o: replace(o, camera_from_target=MIRROR @ o.camera_from_target @ MIRROR),
        "one of the axes of camera_from_target seems to be mirrored",
    ),
    "sign of a column": (
        lambda o: replace(o, camera_from_target=sign_changed(o.camera_from_target, 1)),
        "camera_from_target.y seems to have the wrong sign",
    ),
}

FLANGE: dict[str, tuple[Change, str]] = {
    "swapped": (
        lambda o: replace(o, flange=inverse(o.flange)),
        "flange.* seems to be the base in the flange: base and flange are swapped",
    ),
    "mm": (lambda o: replace(o, flange=scaled(o.flange, 1000.0)), "it seems to be in mm"),
    "sign of a column": (
        lambda o: replace(o, flange=sign_changed(o.flange, 0)),
        "flange.x seems to have the wrong sign",
    ),
}


def joints(observations: Observations, change: dict[str, np.ndarray]) -> Observations:
    return replace(observations, joints={**observations.joints, **change})


JOINTS: dict[str, tuple[Change, str]] = {
    "mirrored axis": (
        lambda o: joints(o, {"j3": -o.joints["j3"]}),
        "joint j3 seems to turn the other way than the model's axis",
    ),
    "degrees": (
        lambda o: joints(o, {name: np.rad2deg(v) for name, v in o.joints.items()}),
        "seem to be in degrees",
    ),
}


@pytest.mark.parametrize("mount", ["hand", "world"])
@pytest.mark.parametrize("mistake", [*CAMERA, *(f"flange {name}" for name in FLANGE)])
def test_a_mistake_in_the_poses_is_reported(mistake: str, mount: str) -> None:
    rng = np.random.default_rng(0)
    flange = np.array([cells.pose(rng, 0.4) for _ in range(25)])
    cell = cells.flange_cell(rng, flange, mount=mount)
    change, words = {**CAMERA, **{f"flange {k}": v for k, v in FLANGE.items()}}[mistake]
    found = calibrate(cells.plan("hand_eye", mount=mount), change(cell.observations), None)
    assert found["verdict"] == "rejected"
    assert any(words in one["what"] for one in found["suspected"])
    assert any(words in reason for reason in found["reasons"])
    # Further poses are not proposed as a remedy for a wrong file.
    assert not any("turn the flange" in reason for reason in found["reasons"])


def test_poses_that_are_both_inverted_are_doubted_by_where_the_camera_would_be() -> None:
    """Residuals cannot tell: the two unknown poses exchange their places."""
    rng = np.random.default_rng(0)
    cell = cells.flange_cell(rng, np.array([cells.pose(rng, 0.4) for _ in range(25)]))
    columns = cell.observations
    assert columns.flange is not None
    assert columns.camera_from_target is not None
    inverted = replace(
        columns,
        flange=inverse(columns.flange),
        camera_from_target=inverse(columns.camera_from_target),
    )
    words = "flange.* and camera_from_target are both inverted"
    for given, is_doubted in ((columns, False), (inverted, True)):
        found = calibrate(cells.plan("hand_eye", "base_world"), given, None)
        assert found["suspected"] == []
        assert any(words in note for note in found["notes"]) is is_doubted


@pytest.mark.parametrize("mistake", JOINTS)
def test_a_mistake_in_the_joint_positions_is_reported(mistake: str) -> None:
    rng = np.random.default_rng(1)
    chain = cells.arm(6, rng)
    cell = cells.joint_cell(rng, chain, 30)
    change, words = JOINTS[mistake]
    found = calibrate(cells.plan("hand_eye"), change(cell.observations), chain)
    assert found["verdict"] == "rejected"
    assert words in found["suspected"][0]["what"]


def test_wrong_joint_zeros_cause_no_suspicion() -> None:
    rng = np.random.default_rng(2)
    chain = cells.arm(6, rng)
    cell = cells.joint_cell(rng, chain, 40, zeros=rng.normal(0.0, 0.02, 6))
    found = calibrate(cells.plan("hand_eye"), cell.observations, chain)
    assert found["fitted"]["translation_rms"] > 0.003
    assert found["suspected"] == []


def test_poses_of_other_rows_are_rejected_without_a_factor_that_shrinks_them_away() -> None:
    rng = np.random.default_rng(4)
    flange = np.array([cells.pose(rng, 0.4) for _ in range(25)])
    cell = cells.flange_cell(rng, flange)
    shifted = replace(
        cell.observations, camera_from_target=np.roll(cell.observations.camera_from_target, 1, 0)
    )
    found = calibrate(cells.plan("hand_eye", accept=Accept(0.002)), shifted, None)
    assert found["verdict"] == "degenerate"
    assert not any("factor" in one["what"] for one in found["suspected"])
