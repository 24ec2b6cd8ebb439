"""Patterns of residual errors: simulated patterns are recognized, random errors have none."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import cells
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.calibrate import calibrate, solve_problem
from pytest_twin.calibration.observations import load_observations
from pytest_twin.calibration.plan import HoldOut
from pytest_twin.calibration.problem import make_problem
from pytest_twin.calibration.reach_hypotheses import hypotheses_in_words, reach_hypotheses
from pytest_twin.calibration.residual_errors import errors_of
from pytest_twin.calibration.residual_patterns import Residuals, pattern_of
from pytest_twin.calibration.split import split
from pytest_twin.metrics.pose import rigid
from pytest_twin.realization.serial_chain import SerialChain

NOISE_M = 1e-3


def random_residuals(rng: np.random.Generator, count: int = 30) -> Residuals:
    """Random errors of 1 mm at poses with random reach and speed and with two payloads."""
    error = NOISE_M * rng.normal(size=(count, 3))
    turns = Rotation.random(count, random_state=int(rng.integers(2**31))).as_matrix()
    return Residuals(
        error,
        np.einsum("nij,nj->ni", turns, error),
        rng.uniform(0.3, 0.9, count),
        rng.uniform(0.0, 0.5, (count, 1)) * rng.normal(size=(count, 3)),
        ["empty", "2 kg"] * (count // 2),
    )


def test_random_errors_have_no_pattern() -> None:
    rng = np.random.default_rng(1)
    found = [pattern_of(random_residuals(rng, int(rng.choice([6, 12, 30])))) for _ in range(300)]
    # Each of the four tests has a significance level of 0.1 %.
    assert sum(one is not None for one in found) <= 4


@pytest.mark.parametrize("seed", range(3))
def test_a_constant_bias_is_attributed_to_a_frame(seed: int) -> None:
    random = random_residuals(np.random.default_rng(seed))
    bias = np.array([2e-3, -1e-3, 2e-3])
    found = pattern_of(replace(random, error=random.error + bias))
    assert found is not None
    assert found["kind"] == "constant"
    np.testing.assert_allclose(found["bias"], bias, atol=4 * NOISE_M / np.sqrt(30))
    assert "a frame is off" in found["words"]


@pytest.mark.parametrize("seed", range(3))
def test_errors_that_grow_with_reach_are_attributed_to_a_joint_or_link(seed: int) -> None:
    random = random_residuals(np.random.default_rng(seed))
    grown = random.error * (random.reach[:, None] / 0.4) ** 4
    found = pattern_of(replace(random, error=grown, rate=np.full((30, 3), np.nan)))
    assert found is not None
    assert found["kind"] == "grows_with_reach"
    assert "joint zeros, link geometry or compliance" in found["words"]


@pytest.mark.parametrize("late", [0.02, -0.02])
def test_errors_along_the_velocity_are_attributed_to_a_time_offset(late: float) -> None:
    random = random_residuals(np.random.default_rng(5))
    found = pattern_of(replace(random, error=random.error + late * random.rate))
    assert found is not None
    assert found["kind"] == "grows_with_speed"
    assert found["time_offset"] == pytest.approx(late, rel=0.15)
    assert f"ms {'later' if late > 0 else 'earlier'} than what was measured" in found["words"]


def test_errors_in_all_directions_that_grow_with_speed_are_attributed_to_compliance() -> None:
    random = random_residuals(np.random.default_rng(6))
    speed = np.linalg.norm(random.rate, axis=1, keepdims=True)
    found = pattern_of(replace(random, error=random.error * (0.1 + 10.0 * speed)))
    assert found is not None
    assert found["kind"] == "grows_with_speed"
    assert "time_offset" not in found
    assert "compliance" in found["words"]


def hypotheses_for(chain: SerialChain, readings: np.ndarray, flange: np.ndarray):
    """Hypotheses of a calibration without joint zeros and geometry, for the true flange poses."""
    rng = np.random.default_rng(12)
    cell = cells.flange_cell(rng, flange, translation=2e-4, rotation=4e-4)
    joints = dict(zip(chain.joints, readings.T, strict=True))
    observations = replace(cell.observations, flange=None, joints=joints)
    plan = cells.plan("hand_eye", hold_out=HoldOut(0.4, 1))
    problem = make_problem(plan, observations, chain)
    fit_rows, held_rows = split(plan, observations)
    fit = solve_problem(problem.on_rows(fit_rows)).estimate.fit
    held = replace(problem, layout=fit.problem.layout).on_rows(held_rows)
    return reach_hypotheses(fit, held, errors_of(held, fit.state))


@pytest.mark.parametrize("hidden", ["joint_zeros", "geometry", "compliance"])
def test_the_hypothesis_of_growth_with_reach_is_the_hidden_cause_or_unclear(hidden: str) -> None:
    rng = np.random.default_rng(3)
    chain = cells.arm(6, rng)
    readings = rng.uniform(-1.2, 1.2, (90, 6))
    real, moved = chain, readings
    if hidden == "joint_zeros":
        moved = readings + np.array([0.0, 0.03, -0.02, 0.0, 0.0, 0.0])
    elif hidden == "geometry":
        placements = chain.placements.copy()
        placements[1:, :3, 3] += rng.normal(0.0, 0.004, (5, 3))
        real = replace(chain, placements=placements)
    else:
        # Joint 2 bends under the weight of an arm whose mass is at the flange.
        lever = np.linalg.norm(cells.forward(chain, readings)[:, :2, 3], axis=1)
        moved = readings + np.outer(0.05 * lever, [0.0, 1.0, 0.6, 0.0, 0.0, 0.0])
    found = hypotheses_for(chain, readings, cells.forward(real, moved))
    words = hypotheses_in_words(found)
    assert {one["cause"] for one in found} == {"joint_zeros", "geometry", "compliance"}
    if hidden == "compliance":
        assert "most likely joint zeros" not in words
        assert "most likely geometry" not in words
    else:
        assert words.startswith(f"most likely {hidden.replace('_', ' ')} ")
    assert "add joint_zeros to estimate" in words
    assert "another payload" in words


def test_growth_with_reach_of_flange_poses_asks_for_the_robot() -> None:
    rng = np.random.default_rng(13)
    cell = cells.flange_cell(rng, np.array([cells.pose(rng, 0.4) for _ in range(20)]))
    problem = make_problem(cells.plan("hand_eye"), cell.observations, None)
    fit = solve_problem(problem).estimate.fit
    found = reach_hypotheses(fit, fit.problem, errors_of(fit.problem, fit.state))
    assert found[0]["cause"] == "joint_zeros or geometry"
    assert "give robot:" in hypotheses_in_words(found)


def cell_with_payloads(direction: list[float]):
    """A hand-eye cell in which the second payload displaces the flange by 2 mm."""
    rng = np.random.default_rng(3)
    turns = Rotation.random(60, random_state=3).as_matrix()
    flange = np.array([rigid(turn, rng.uniform(-0.3, 0.3, 3)) for turn in turns])
    moved = flange.copy()
    moved[::2, :3, 3] += 2e-3 * np.array(direction)
    cell = cells.flange_cell(rng, moved, translation=3e-4, rotation=3e-4)
    return replace(cell.observations, flange=flange, payloads=("2 kg", "empty") * 30)


def test_a_displacement_by_payload_along_gravity_is_attributed_to_elasticity() -> None:
    plan = cells.plan("hand_eye", "base_world", hold_out=HoldOut(0.5, 1))
    found = calibrate(plan, cell_with_payloads([0.0, 0.0, -1.0]), None)["held_out"]["pattern"]
    assert found["kind"] == "payloads_apart"
    assert set(found["payloads"]) == {"2 kg", "empty"}
    low, high = sorted(abs(value) for value in found["ci95"])
    assert low < 2e-3 < high
    assert "elasticity" in found["words"]


def test_a_displacement_by_payload_perpendicular_to_gravity_is_not_attributed_to_elasticity() -> (
    None
):
    plan = cells.plan("hand_eye", "base_world", hold_out=HoldOut(0.5, 1))
    found = calibrate(plan, cell_with_payloads([1.0, 0.0, 0.0]), None)["held_out"]["pattern"]
    assert found is None or found["kind"] != "payloads_apart"


def test_a_time_offset_between_poses_and_camera_is_found_from_the_residuals() -> None:
    """Poses are sampled at 50 Hz during motion; the camera shows the pose of 20 ms later."""
    rng = np.random.default_rng(8)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    rate = rng.uniform(1.0, 2.0, 6)

    def flange(time: np.ndarray) -> np.ndarray:
        waves = np.sin(time[:, None] * rate + phase) * np.array([0.2, 0.2, 0.2, 0.8, 0.8, 0.8])
        return np.array([rigid(Rotation.from_rotvec(w[3:]).as_matrix(), w[:3]) for w in waves])

    time = np.arange(0.0, 4.0, 0.02)
    # The speed varies periodically.
    warped = time + 0.45 * np.sin(2.0 * time)
    later = time + 0.02
    cell = cells.flange_cell(
        rng, flange(later + 0.45 * np.sin(2.0 * later)), translation=1e-4, rotation=1e-4
    )
    observations = replace(cell.observations, flange=flange(warped), time=time)
    plan = cells.plan("base_world", given={"hand_eye": cell.mounted}, hold_out=HoldOut(0.3, 1))
    # A free size of the target would take up a part of the error.
    exact = replace(plan, target={"tolerance": 0.0})
    found = calibrate(exact, observations, None)["held_out"]["pattern"]
    assert found["kind"] == "grows_with_speed"
    # The fitted base pose compensates a part of the offset.
    assert -0.02 < found["time_offset"] < -0.01


def test_the_payload_of_each_observation_is_read_from_a_column(tmp_path: Path) -> None:
    table = tmp_path / "observations.csv"
    with table.open("w", newline="") as file:
        csv.writer(file).writerows(
            [["id", "joint.j1", "payload"], ["a", "0.1", "empty"], ["b", "0.2", ""]]
        )
    found = load_observations(table)
    assert found.payloads == ("empty", "")
    assert found.rows([1]).payloads == ("",)
    assert found.notes == ()
