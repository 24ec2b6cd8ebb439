"""Errors that repeat with the pose widen the intervals: a wrong controller or a wrong lens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from cells import arm, flange_cell, forward, noisy, plan, seen

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations
from pytest_twin.metrics.pose import rotation_of, rotation_vector

SEEDS = range(6)


def document(observations: Observations) -> dict[str, Any]:
    return calibrate(plan("hand_eye", "base_world"), observations, None)


def misses(document: dict[str, Any], mounted: np.ndarray, world: np.ndarray) -> float:
    """The largest error of both frames, in half widths of its interval."""
    largest = 0.0
    truths = {"hand_eye": mounted, "base_world": np.linalg.inv(world)}
    for name, truth in truths.items():
        record = document["records"][name]
        half = np.array([np.diff(record["ci95"][axis])[0] for axis in record["covariance_of"]]) / 2
        turned = rotation_of(np.array(record["transform"]["quaternion_wxyz"])).T @ truth[:3, :3]
        errors = [
            *(np.array(record["transform"]["xyz"]) - truth[:3, 3]),
            *rotation_vector(turned),
        ]
        largest = max(largest, float(np.max(np.abs(errors) / half)))
    return largest


def wrong_arm(seed: int, zeros: np.ndarray) -> tuple[Observations, np.ndarray, np.ndarray]:
    """Flange poses of a controller with wrong joint zeros, rad; the true frames."""
    rng = np.random.default_rng(seed)
    chain = arm(6, rng)
    readings = rng.uniform(-1.0, 1.0, (45, 6))
    cell = flange_cell(rng, forward(chain, readings + zeros))
    reported = forward(chain, readings)
    observations = Observations(
        ids=cell.observations.ids,
        flange=reported,
        camera_from_target=cell.observations.camera_from_target,
    )
    return observations, cell.mounted, cell.world


@pytest.mark.parametrize("joint", [1, 2, 3, 4])
def test_a_wrong_zero_in_the_controller_widens_the_intervals(joint: int) -> None:
    zeros = np.zeros(6)
    zeros[joint] = np.radians(0.5)
    found = []
    for seed in SEEDS:
        observations, mounted, world = wrong_arm(seed, zeros)
        result = document(observations)
        kinds = [one["kind"] for one in result["fitted"].get("pose_errors", [])]
        assert kinds == ["flange"]
        assert any("follow the flange's pose" in note for note in result["notes"])
        found.append(misses(result, mounted, world))
    assert max(found) < 2.5, found


def test_a_wrong_focal_length_widens_the_intervals_and_is_named() -> None:
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        flange = forward(arm(6, rng), rng.uniform(-1.0, 1.0, (45, 6)))
        cell = flange_cell(rng, flange)
        measured = cell.observations.camera_from_target
        assert measured is not None
        measured[:, 2, 3] *= 1.02
        result = document(cell.observations)
        (one,) = [one for one in result["fitted"]["pose_errors"] if one["kind"] == "depth"]
        assert one["probability"] < 1e-6
        (note,) = [note for note in result["notes"] if "focal length" in note]
        assert "0.98" in note
        assert result["verdict"] == "rejected" or misses(result, cell.mounted, cell.world) < 2.5


def test_a_wrong_scale_of_a_tracker_widens_the_intervals() -> None:
    markers = {"m1": [0.05, 0.0, 0.04], "m2": [-0.04, 0.06, 0.02], "m3": [0.0, -0.05, 0.07]}
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        flange = forward(arm(6, rng), rng.uniform(-1.0, 1.0, (45, 6)))
        base = flange_cell(rng, flange).world
        base[:3, 3] += [1.5, 0.0, 0.5]
        points = {
            name: np.array(
                [
                    1.01 * (np.linalg.inv(base) @ pose @ [*at, 1.0])[:3] + rng.normal(0, 3e-4, 3)
                    for pose in flange
                ]
            )
            for name, at in markers.items()
        }
        ids = tuple(str(row) for row in range(len(flange)))
        observations = Observations(ids=ids, flange=flange, points=points)
        result = calibrate(plan("base_world", mount="world"), observations, None)
        (one,) = result["fitted"]["pose_errors"]
        assert one["kind"] == "scale"
        assert any("0.99" in note and "tracker's scale" in note for note in result["notes"])
        record = result["records"]["base_world"]
        truth = np.linalg.inv(base)[:3, 3]
        for at, axis in enumerate("xyz"):
            low, high = record["ci95"][axis]
            middle, half = (low + high) / 2, (high - low) / 2
            assert abs(middle - truth[at]) < 2.5 * half


def test_independent_errors_do_not_widen_the_intervals() -> None:
    widened = 0
    for seed in range(20):
        rng = np.random.default_rng(100 + seed)
        flange = forward(arm(6, rng), rng.uniform(-1.0, 1.0, (30, 6)))
        result = document(flange_cell(rng, flange).observations)
        assert result["verdict"] == "accepted"
        assert any("flange.* are taken as they are" in note for note in result["notes"])
        widened += "pose_errors" in result["fitted"]
    # Two tests at 1 % each.
    assert widened <= 2


def test_a_fit_without_a_third_of_its_rows_is_rejected() -> None:
    rng = np.random.default_rng(3)
    flange = forward(arm(6, rng), rng.uniform(-1.0, 1.0, (36, 6)))
    cell = flange_cell(rng, flange)
    wrong = np.arange(0, 36, 3)
    elsewhere = noisy(seen(flange, cell.mounted, cell.world, "hand"), 0.05, 0.1, rng)
    measured = cell.observations.camera_from_target
    assert measured is not None
    measured[wrong] = elsewhere[wrong]
    result = document(cell.observations)
    assert result["verdict"] == "rejected"
    assert any("do not agree with the others" in reason for reason in result["reasons"])
