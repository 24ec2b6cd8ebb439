"""Rows that repeat another one count once, in any order."""

from __future__ import annotations

from dataclasses import replace

import cells
import numpy as np
import pytest

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations, in_order
from pytest_twin.calibration.plan import Accept, HoldOut
from pytest_twin.calibration.repeated_rows import without_repeats
from pytest_twin.errors import SpecError

PLAN = cells.plan("hand_eye", "base_world", accept=Accept(0.002, 0.004), hold_out=HoldOut(0.33, 1))


def cell_of(rows: int, seed: int = 5, mount: str = "hand") -> cells.Cell:
    rng = np.random.default_rng(seed)
    return cells.flange_cell(
        rng, np.array([cells.pose(rng, 0.4) for _ in range(rows)]), mount=mount
    )


def repeated(observations: Observations, times: int, noise: float = 0.0) -> Observations:
    """Each row several times, the target measured again with another noise."""
    count = len(observations)
    found = observations.rows(np.tile(np.arange(count), times))
    poses = cells.noisy(found.camera_from_target, noise, noise, np.random.default_rng(0))
    return replace(
        found, ids=tuple(str(at) for at in range(times * count)), camera_from_target=poses
    )


def test_copies_of_rows_count_once_and_are_named() -> None:
    once = cell_of(10).observations
    alone, found = (calibrate(PLAN, each, None) for each in (once, repeated(once, 3)))
    assert found["records"] == alone["records"]
    assert found["held_out"] == alone["held_out"]
    assert [one["id"] for one in found["excluded"]] == [str(at) for at in range(10, 30)]
    assert found["excluded"][0]["why"] == "the robot and the target as in 0: counted once"


def test_a_recorder_at_rest_counts_once_for_each_pose() -> None:
    found = calibrate(PLAN, repeated(cell_of(12).observations, 5, noise=3e-4), None)
    assert found["fitted"]["count"] + found["held_out"]["count"] == 12


@pytest.mark.parametrize("noise", [1e-4, 4e-4])
def test_a_recorder_at_rest_counts_once_also_with_noisy_encoders(noise: float) -> None:
    """Noise of the flange above the changes up to which an arm counts as being at rest, m."""
    rows = repeated(cell_of(12).observations, 5, noise=3e-4)
    flange = cells.noisy(rows.flange, noise, noise, np.random.default_rng(3))
    found = calibrate(PLAN, replace(rows, flange=flange), None)
    assert found["fitted"]["count"] + found["held_out"]["count"] == 12


def test_small_motions_are_no_rest() -> None:
    """Poses a millimetre apart along a path are different poses."""
    once = cell_of(30).observations
    assert once.flange is not None
    flange = np.repeat(once.flange[:1], 30, axis=0)
    flange[:, 0, 3] += 1e-3 * np.arange(30)
    _, left_out = without_repeats(PLAN, replace(once, flange=flange))
    assert left_out == ()


def test_rows_of_one_pose_that_contradict_each_other_are_no_copies() -> None:
    once = cell_of(20).observations
    twice = repeated(once, 2)
    poses = twice.camera_from_target.copy()
    poses[25, :3, 3] += 0.05
    found = calibrate(PLAN, replace(twice, camera_from_target=poses), None)
    (wrong,) = [one for one in found["excluded"] if one["id"] == "25"]
    assert "off" in wrong["why"] or "outlier" in wrong["why"]


def test_a_held_out_copy_of_a_fitted_row_is_refused() -> None:
    plan = cells.plan("hand_eye", hold_out=HoldOut(ids=("3", "13", "14")))
    with pytest.raises(SpecError, match="held out and repeats 4, which is fitted") as caught:
        calibrate(plan, repeated(cell_of(10).observations, 2), None)
    assert caught.value.value == "14"


@pytest.mark.parametrize("stamped", [True, False])
def test_the_order_of_the_rows_has_no_influence(stamped: bool) -> None:
    observations = cell_of(30).observations
    if stamped:
        observations = replace(observations, time=2.0 * np.arange(30))
    shuffled = observations.rows(np.random.default_rng(1).permutation(30))
    found, other = (
        calibrate(PLAN, in_order(each, is_motion=False), None) for each in (observations, shuffled)
    )
    assert found == other


def test_held_out_rows_are_drawn_by_id() -> None:
    observations = cell_of(30).observations
    shuffled = observations.rows(np.random.default_rng(1).permutation(30))
    found, other = (calibrate(PLAN, each, None)["held_out"] for each in (observations, shuffled))
    assert set(found["ids"]) == set(other["ids"])
    assert found["translation_rms"] == pytest.approx(other["translation_rms"], rel=1e-6)
