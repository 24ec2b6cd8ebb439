"""Proposals of further calibration poses."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cells
import numpy as np

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import HoldOut

NONE_HELD = HoldOut(0.0)


def simulated_observations(rng, chain, readings, truth) -> Observations:
    """Observations of a camera on the hand at these joint readings."""
    mounted, world = truth
    seen = cells.seen(cells.forward(chain, readings), mounted, world, "hand")
    return Observations(
        ids=tuple(str(i) for i in range(len(readings))),
        joints=dict(zip(chain.joints, readings.T, strict=True)),
        camera_from_target=cells.noisy(seen, 5e-4, 1e-3, rng),
    )


def volume(found: dict) -> float:
    """Logarithm of the volume of the uncertainty ellipsoid, normalized by the estimated noise."""
    sources = found["fitted"]["noise"]
    size = 6.0 * np.log(sources["translation"] * sources["rotation"])
    return float(np.linalg.slogdet(np.array(found["covariance"]["matrix"]))[1] / 2.0 - size)


def test_proposed_poses_are_within_limits_and_more_informative_than_random_ones() -> None:
    rng = np.random.default_rng(0)
    chain = cells.arm(6, rng)
    chain = replace(chain, limits=np.tile([-1.5, 1.5], (6, 1)))
    truth = cells.pose(rng, 0.1), cells.pose(rng, 0.8)
    # The poses are very similar.
    readings = rng.uniform(-0.25, 0.25, (15, 6))
    plan = cells.plan("hand_eye", "base_world", hold_out=NONE_HELD)
    first = calibrate(plan, simulated_observations(rng, chain, readings, truth), chain)
    proposed = first["next_poses"]["poses"]
    more = np.array([[one["joints"][name] for name in chain.joints] for one in proposed])
    assert more.shape == (5, 6)
    assert np.abs(more).max() <= 1.5
    assert all(a["information"] >= b["information"] > 0 for a, b in itertools.pairwise(proposed))
    then = calibrate(
        plan, simulated_observations(rng, chain, np.vstack([readings, more]), truth), chain
    )
    others = [
        calibrate(
            plan,
            simulated_observations(
                rng, chain, np.vstack([readings, rng.uniform(-0.25, 0.25, (5, 6))]), truth
            ),
            chain,
        )
        for _ in range(2)
    ]
    assert volume(then) < min(volume(one) for one in others) - 1.5
    stated = first["next_poses"]
    assert (
        stated["predictions_then"]["translation"] < 0.7 * stated["predictions_now"]["translation"]
    )


def test_for_poses_with_one_rotation_axis_rotations_about_other_axes_are_proposed() -> None:
    rng = np.random.default_rng(1)
    chain = cells.arm(5, rng)
    truth = cells.pose(rng, 0.1), cells.pose(rng, 0.8)
    readings = np.zeros((12, 5))
    readings[:, 1] = np.linspace(-1.0, 1.0, 12)
    plan = cells.plan("hand_eye", "base_world", hold_out=NONE_HELD)
    first = calibrate(plan, simulated_observations(rng, chain, readings, truth), chain)
    assert first["verdict"] == "degenerate"
    turns = first["pose_diversity"]["turns"]
    assert turns[0] > 0.5
    assert turns[1] < 1e-6
    more = np.array(
        [[one["joints"][name] for name in chain.joints] for one in first["next_poses"]["poses"]]
    )
    then = calibrate(
        plan, simulated_observations(rng, chain, np.vstack([readings, more]), truth), chain
    )
    assert then["verdict"] == "accepted"
