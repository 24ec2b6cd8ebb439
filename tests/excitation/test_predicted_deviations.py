"""Predicted standard deviations agree with the scatter of estimates over simulated noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from approved_arms import Excited, approved_for_arm, loaded, write_twin

from pytest_twin.excitation.d_optimal import Design
from pytest_twin.excitation.excite import Excitation, excite
from pytest_twin.excitation.find_safe import SafeMotion
from pytest_twin.excitation.prediction import at_rest, delay, inertia

_RUNS = 400


@pytest.fixture(scope="module")
def found(excited: Excited) -> Excitation:
    return excited.found


def motion_of(found: Excitation, name: str) -> SafeMotion:
    return next(one for one in found.safe if one.motion.name == name)


def test_the_scatter_of_base_parameters_agrees_with_the_prediction(found: Excitation) -> None:
    motion = motion_of(found, "fourier_fit").motion
    matrix = found.base.matrix(
        found.regressor.matrix(motion.position, motion.velocity, motion.acceleration)
    )
    predicted = {p.name: p for p in found.predicted if p.mechanism == "inertia"}
    weights = 1.0 / np.tile(found.noise.effort, len(motion.time))
    stacked = matrix.reshape(-1, matrix.shape[-1])
    truth = found.base.values(found.regressor.prior)
    random = np.random.default_rng(4)
    noise = random.standard_normal((len(stacked), _RUNS)) / weights[:, None]
    efforts = (stacked @ truth)[:, None] + noise
    solved = np.linalg.lstsq(stacked * weights[:, None], efforts * weights[:, None], rcond=None)[0]
    std = np.array([predicted[name].std for name in found.base.names])
    # The relative error of a standard deviation from 400 runs is 3.5 %.
    assert np.abs(solved.std(axis=1) / std - 1.0).max() < 0.15
    inside = np.abs(solved - truth[:, None]) <= 1.96 * std[:, None]
    assert 0.93 < inside.mean() < 0.97


def test_the_scatter_of_a_delay_agrees_with_the_prediction(found: Excitation) -> None:
    one = motion_of(found, "steps_lift_fit")
    position, time = one.response.position[:, 0], one.motion.time
    speed = one.response.velocity[:, 0]
    predicted = delay([one.response], 0, found.approved, found.noise)
    random = np.random.default_rng(5)
    measured = position + found.noise.position[0] * random.standard_normal((_RUNS, len(time)))
    # Least-squares estimate of a small delay: measured = position - delay * speed.
    delays = -(measured - position) @ speed / (speed @ speed)
    assert delays.std() / predicted.std == pytest.approx(1.0, abs=0.12)


def test_the_optimal_motion_is_more_informative_than_random_ones(found: Excitation) -> None:
    design = Design(found.approved, found.regressor, found.base, found.noise.effort)
    best = motion_of(found, "fourier_fit").motion.settings["log_det"]
    assert best > max(design.log_det(design.random(seed)) for seed in range(20))


def test_the_predicted_deviation_is_proportional_to_the_noise(found: Excitation) -> None:
    motion = motion_of(found, "fourier_fit").motion
    louder = replace(found.noise, effort=2.0 * found.noise.effort)
    before, after = (
        inertia([motion], found.base, found.regressor, found.approved, noise)
        for noise in (found.noise, louder)
    )
    ratios = [b.std / a.std for a, b in zip(before, after, strict=True)]
    assert ratios == pytest.approx([2.0] * len(ratios))


def test_poses_at_rest_are_approached_from_both_directions(found: Excitation) -> None:
    motion = motion_of(found, "grid_fit").motion
    still = at_rest(motion, found.approved.rate)
    assert len(still) > 50
    assert np.all(motion.velocity[still] == 0.0)
    dwells = np.split(still, np.flatnonzero(np.diff(still) > 1) + 1)[1:-1]
    before = [motion.velocity[d[0] - 1 - round(0.1 * found.approved.rate) - 1] for d in dwells]
    signs = np.sign(np.array(before))
    # The direction alternates in every joint.
    assert np.all(signs[0::2][:-1] == -signs[1::2][: len(signs[0::2][:-1])])


def test_a_joint_with_very_small_limits_is_not_identifiable(
    tmp_path: Path, found: Excitation
) -> None:
    assert all(one.is_identifiable for one in found.predicted)
    section = approved_for_arm(mechanisms=["inertia"])
    section["joints"]["elbow"].update(
        position=[0.25, 0.35], velocity=0.02, acceleration=0.1, effort_noise=1.0
    )
    small = excite(*loaded(write_twin(tmp_path, section)))
    names = {one.name for one in small.predicted if not one.is_identifiable}
    assert [one.motion.name for one in small.safe] == ["fourier_fit", "fourier_held_out"]
    assert {"elbow.viscous_friction", "elbow.coulomb_friction"} <= names
