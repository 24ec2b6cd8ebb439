"""Calibration of simulated cells: coverage of intervals, outliers, and insufficient poses."""

from __future__ import annotations

import time
from dataclasses import replace

import cells
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.plan import Accept, HoldOut
from pytest_twin.metrics.pose import rigid

WHOLE = ("joint_zeros", "hand_eye", "base_world")


def random_cell(seed: int) -> tuple[cells.Cell, str]:
    """A robot with 4 to 7 joints, zero errors of 20 mrad, noise of 0.03 to 3 mm, and outliers."""
    rng = np.random.default_rng(seed)
    mount = ("hand", "world")[seed % 2]
    count = int(rng.integers(4, 8))
    chain = cells.arm(count, rng)
    zeros = rng.normal(0.0, 0.02, count)
    zeros[[0, -1]] = 0.0
    rows = int(rng.integers(14, 50))
    noise = float(10 ** rng.uniform(-4.5, -2.5))
    cell = cells.joint_cell(
        rng,
        chain,
        rows,
        mount=mount,
        zeros=zeros,
        translation=noise,
        rotation=noise * float(rng.uniform(0.5, 4.0)),
    )
    if seed % 3 == 0:
        bad = rng.choice(rows, rows // 10, replace=False)
        cell.observations = cells.with_outliers(cell.observations, list(bad), 0.05)
    return cell, mount


@pytest.mark.nightly
def test_95_percent_intervals_contain_the_true_values_in_90_to_99_percent_of_cases() -> None:
    inside = []
    for seed in range(20):
        cell, mount = random_cell(seed)
        found = calibrate(cells.plan(*WHOLE, mount=mount), cell.observations, cell.chain)
        truth = cell.mounted if mount == "hand" else cell.world
        inside += cells.truth_inside(found, "hand_eye", truth)
        for joint, stated in found["records"]["joint_zeros"]["values"].items():
            low, high = stated["ci95"]
            inside.append(low <= cell.zeros[cell.chain.joints.index(joint)] <= high)
    assert len(inside) > 160
    assert 0.90 <= np.mean(inside) <= 0.99


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    kind=st.sampled_from(["one axis", "no rotation", "two poses"]),
    mount=st.sampled_from(["hand", "world"]),
    flange_noise=st.sampled_from([0.0, 1e-5, 1e-3]),
)
def test_poses_that_do_not_determine_the_camera_are_refused(
    seed: int, kind: str, mount: str, flange_noise: float
) -> None:
    rng = np.random.default_rng(seed)
    rows = 2 if kind == "two poses" else 25
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    start = Rotation.random(random_state=seed)
    poses = []
    for _ in range(rows):
        angle = 0.0 if kind == "no rotation" else rng.uniform(-1.5, 1.5)
        turn = start * Rotation.from_rotvec(axis * angle)
        if kind == "two poses":
            turn = Rotation.random(random_state=int(rng.integers(2**31)))
        poses.append(rigid(turn.as_matrix(), rng.uniform(-0.4, 0.4, 3)))
    cell = cells.flange_cell(rng, np.array(poses), mount=mount)
    measured = cells.noisy(np.array(poses), flange_noise, flange_noise, rng)
    observations = replace(cell.observations, flange=measured)
    hold_out = HoldOut(0.0 if rows == 2 else 0.2)
    plan = cells.plan("hand_eye", "robot_world", mount=mount, hold_out=hold_out)
    found = calibrate(plan, observations, None)
    assert found["verdict"] == "degenerate"
    assert "hand_eye" not in found["records"]
    assert found["unobservable"]


@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("accept", [None, 3.0])
def test_poses_that_rotate_by_only_a_milliradian_are_refused(
    noise: float, accept: float | None
) -> None:
    rng = np.random.default_rng(3)
    turns = Rotation.from_rotvec(rng.uniform(-1e-3, 1e-3, (25, 3))).as_matrix()
    flange = np.array([rigid(turn, rng.uniform(-0.3, 0.3, 3)) for turn in turns])
    cell = cells.flange_cell(rng, flange, translation=noise, rotation=2.0 * noise)
    bounds = Accept() if accept is None else Accept(accept * noise, 2.0 * accept * noise)
    found = calibrate(cells.plan("hand_eye", accept=bounds), cell.observations, None)
    assert found["verdict"] == "degenerate"
    assert "hand_eye" not in found["records"]


def test_poses_that_do_not_determine_the_rest_of_the_workspace_are_refused() -> None:
    rng = np.random.default_rng(4)
    turns = Rotation.from_rotvec(rng.uniform(-0.01, 0.01, (40, 3))).as_matrix()
    flange = np.array([rigid(turn, rng.uniform(-0.1, 0.1, 3)) for turn in turns])
    cell = cells.flange_cell(rng, flange, translation=3e-4, rotation=1e-3)
    plan = cells.plan("hand_eye", accept=Accept(translation=1e-3))
    found = calibrate(plan, cell.observations, None)
    assert found["held_out"]["translation_rms"] < 1e-3
    assert found["verdict"] == "degenerate"
    assert "in other poses of the workspace predictions are off by" in found["reasons"][0]


def test_the_sources_of_error_are_distinguished() -> None:
    rng = np.random.default_rng(5)
    flange = np.array([cells.pose(rng, 0.4) for _ in range(150)])
    cell = cells.flange_cell(rng, flange, translation=2e-4, rotation=1e-3)
    # The reported flange orientation has an error of 3 mrad, the position none.
    reported = cells.noisy(flange, 0.0, 3e-3, rng)
    observations = replace(cell.observations, flange=reported)
    found = calibrate(cells.plan("hand_eye", hold_out=HoldOut(0.0)), observations, None)
    sources = found["fitted"]["error_sources"]
    assert sources["flange_rotation"] == pytest.approx(3e-3, rel=0.15)
    assert sources["rotation"] == pytest.approx(1e-3, rel=0.3)
    assert sources["across"] == pytest.approx(2e-4, rel=0.5)
    assert sources["flange_translation"] < 3e-4


def test_with_one_axis_of_rotation_the_position_along_it_is_unobservable() -> None:
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.outer(rng.uniform(-1, 1, 20), [0, 0, 1])).as_matrix()
    poses = np.array([rigid(turn, rng.uniform(-0.3, 0.3, 3)) for turn in turns])
    cell = cells.flange_cell(rng, poses)
    found = calibrate(cells.plan("hand_eye"), cell.observations, None)
    (words,) = found["unobservable"]
    assert "the position of the target in the base along z axis" in words
    assert "the position of the camera on the flange along z axis" in words
    assert words.endswith("cannot be distinguished in these poses")


def test_the_turn_about_one_axis_is_named_apart_from_the_shift_along_it() -> None:
    rng = np.random.default_rng(3)
    start, end = cells.pose(rng), cells.pose(rng)
    axis = np.array([0.48, 0.6, 0.64])
    turns = Rotation.from_rotvec(np.outer(rng.uniform(-1.3, 1.3, 30), axis)).as_matrix()
    poses = np.array([start @ rigid(turn, np.zeros(3)) @ end for turn in turns])
    found = calibrate(cells.plan("hand_eye"), cells.flange_cell(rng, poses).observations, None)
    turn, shift = sorted(found["unobservable"], reverse=True)
    assert "the rotation of the camera on the flange" in turn
    assert "the position of the camera on the flange" in shift
    assert "rotation" not in shift


def test_outliers_are_reported_and_excluded_from_the_fit() -> None:
    rng = np.random.default_rng(1)
    chain = cells.arm(6, rng)
    cell = cells.joint_cell(rng, chain, 40)
    bad = [3, 11, 27]
    observations = cells.with_outliers(cell.observations, bad, 0.03)
    plan = cells.plan("hand_eye", "base_world", hold_out=HoldOut(ids=("0", "5", "9", "20", "30")))
    found = calibrate(plan, observations, chain)
    assert [one["id"] for one in found["excluded"]] == ["3", "11", "27"]
    assert "52 mm" in found["excluded"][0]["why"]
    xyz = found["records"]["hand_eye"]["transform"]["xyz"]
    np.testing.assert_allclose(xyz, cell.mounted[:3, 3], atol=6e-4)


def test_a_held_out_outlier_is_excluded_and_the_error_with_it_is_also_reported() -> None:
    rng = np.random.default_rng(1)
    chain = cells.arm(6, rng)
    cell = cells.joint_cell(rng, chain, 40)
    observations = cells.with_outliers(cell.observations, [9], 0.03)
    plan = cells.plan("hand_eye", "base_world", hold_out=HoldOut(ids=("0", "5", "9", "20", "30")))
    found = calibrate(plan, observations, chain)
    (excluded,) = found["excluded"]
    assert excluded["id"] == "9"
    assert excluded["why"].startswith("held out; ")
    held_out = found["held_out"]
    assert held_out["count"] == 4
    assert held_out["with_excluded"]["count"] == 5
    # One of five has an error of 52 mm: the RMS over coordinates is 0.052 / sqrt(3 * 5) m.
    assert held_out["with_excluded"]["translation_rms"] == pytest.approx(0.0134, rel=0.05)
    assert held_out["translation_rms"] < 0.1 * held_out["with_excluded"]["translation_rms"]


def test_intervals_from_a_few_poses_contain_the_true_values_unless_refused() -> None:
    inside = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rows = int(rng.integers(3, 6))
        turns = Rotation.from_rotvec(rng.normal(0.0, 0.4, (rows, 3))).as_matrix()
        flange = np.array([rigid(turn, rng.uniform(-0.15, 0.15, 3)) for turn in turns])
        cell = cells.flange_cell(rng, flange, translation=0.0015, rotation=0.002)
        plan = cells.plan("hand_eye", hold_out=HoldOut(0.0))
        found = calibrate(plan, cell.observations, None)
        if found["verdict"] != "degenerate":
            inside += cells.truth_inside(found, "hand_eye", cell.mounted)
    assert len(inside) >= 60
    assert np.mean(inside) >= 0.9


def test_outliers_among_half_of_the_poses_are_excluded() -> None:
    rng = np.random.default_rng(7)
    flange = np.array([cells.pose(rng, 0.4) for _ in range(30)])
    cell = cells.flange_cell(rng, flange)
    poses = cell.observations.camera_from_target.copy()
    bad = rng.choice(30, 15, replace=False)
    for row in bad:
        poses[row] = cells.pose(rng, 0.6)
    observations = replace(cell.observations, camera_from_target=poses)
    found = calibrate(cells.plan("hand_eye", hold_out=HoldOut(0.0)), observations, None)
    assert {int(one["id"]) for one in found["excluded"]} == set(bad.tolist())
    xyz = found["records"]["hand_eye"]["transform"]["xyz"]
    np.testing.assert_allclose(xyz, cell.mounted[:3, 3], atol=1e-3)


@pytest.mark.parametrize(("bound", "verdict"), [(0.001, "accepted"), (0.0003, "rejected")])
def test_without_held_out_observations_leave_one_out_errors_decide_the_verdict(
    bound: float, verdict: str
) -> None:
    rng = np.random.default_rng(8)
    flange = np.array([cells.pose(rng, 0.4) for _ in range(20)])
    cell = cells.flange_cell(rng, flange, translation=5e-4)
    accept = Accept(translation=bound)
    plan = cells.plan("hand_eye", hold_out=HoldOut(0.0), accept=accept)
    assert calibrate(plan, cell.observations, None)["verdict"] == verdict


def test_without_outliers_no_observation_is_excluded() -> None:
    rng = np.random.default_rng(2)
    chain = cells.arm(6, rng)
    cell = cells.joint_cell(rng, chain, 60)
    found = calibrate(cells.plan("hand_eye"), cell.observations, chain)
    assert found["excluded"] == []


def test_an_unestimated_joint_zero_causes_a_rejection_with_errors_by_region() -> None:
    rng = np.random.default_rng(3)
    chain = cells.arm(6, rng)
    cell = cells.joint_cell(rng, chain, 60, zeros=np.array([0, 0.03, 0, 0, 0, 0.0]))
    plan = cells.plan("hand_eye", accept=Accept(translation=0.001))
    found = calibrate(plan, cell.observations, chain)
    assert found["verdict"] == "rejected"
    assert [one["region"] for one in found["held_out"]["regions"]] == ["near", "middle", "far"]


def test_a_given_base_makes_the_first_joint_observable() -> None:
    rng = np.random.default_rng(14)
    chain = cells.arm(5, rng)
    zeros = np.array([0.02, 0.0, 0.0, 0.0, 0.0])
    cell = cells.joint_cell(rng, chain, 40, zeros=zeros)
    plan = cells.plan("joint_zeros", "hand_eye", given={"robot_world": cell.world})
    found = calibrate(plan, cell.observations, chain)
    low, high = found["records"]["joint_zeros"]["values"]["j1"]["ci95"]
    assert low < 0.02 < high
    assert len(found["unobservable"]) == 1


def test_estimated_link_geometry_reduces_the_held_out_error() -> None:
    rng = np.random.default_rng(5)
    nominal = cells.arm(6, rng)
    placements = nominal.placements.copy()
    placements[3, :3, 3] += [0.003, 0.0, 0.0]
    real = replace(nominal, placements=placements)
    cell = cells.joint_cell(rng, real, 60, translation=1e-4, rotation=2e-4)
    without = calibrate(cells.plan("hand_eye"), cell.observations, nominal)
    found = calibrate(cells.plan("hand_eye", "geometry"), cell.observations, nominal)
    before, after = (one["held_out"]["translation_rms"] for one in (without, found))
    assert after < 0.2 * before
    offset = found["records"]["geometry"]["values"]["offset along x of j4"]
    assert offset["value"] == pytest.approx(0.003, abs=5e-4)
    assert offset["determined_by"] == "data"


def test_a_calibration_of_130_poses_with_all_geometry_takes_less_than_five_seconds() -> None:
    rng = np.random.default_rng(6)
    chain = cells.arm(7, rng)
    cell = cells.joint_cell(rng, chain, 130, zeros=rng.normal(0.0, 0.01, 7))
    # Other programs on the machine only add to the processor time: the best of three runs counts.
    for _ in range(3):
        start = time.process_time()
        found = calibrate(cells.plan("geometry", *WHOLE), cell.observations, chain)
        seconds = time.process_time() - start
        if seconds < 5.0:
            break
    assert seconds < 5.0
    assert len(found["covariance"]["of"]) >= 35
