"""Calibration from pivoting about the tool tip, touched points and tracked markers."""

from __future__ import annotations

from dataclasses import replace

import cells
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.calibration.closed_form import kabsch
from pytest_twin.calibration.observations import Observations
from pytest_twin.errors import SpecError
from pytest_twin.metrics.pose import inverse, rigid

TIP = np.array([0.01, 0.02, 0.15])
NOISE_M = 2e-4


def random_rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    return Rotation.from_rotvec(rng.normal(0.0, 0.5, (count, 3))).as_matrix()


def transformed(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ transform[:3, :3].T + transform[:3, 3]


def poses_with_tip_at(
    rng: np.random.Generator, rotations: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Flange poses in which the tool tip is at each of the places."""
    noise = rng.normal(0.0, NOISE_M, (len(rotations), 3))
    return np.array(
        [rigid(r, p - r @ TIP + n) for r, p, n in zip(rotations, places, noise, strict=True)]
    )


def pivot_observations(rng: np.random.Generator, rotations: np.ndarray) -> Observations:
    places = np.tile([0.4, 0.1, 0.2], (len(rotations), 1))
    flange = poses_with_tip_at(rng, rotations, places)
    return Observations(ids=tuple(str(i) for i in range(len(flange))), flange=flange)


def test_pivoting_determines_the_position_of_the_tool_tip() -> None:
    rng = np.random.default_rng(0)
    found = calibrate(cells.plan("tcp"), pivot_observations(rng, random_rotations(rng, 25)), None)
    tcp = found["records"]["tcp"]
    assert found["verdict"] == "accepted"
    np.testing.assert_allclose(tcp["transform"]["xyz"], TIP, atol=5e-4)
    assert tcp["transform"]["quaternion_wxyz"] is None
    assert tcp["covariance_of"] == ["x", "y", "z"]
    assert found["held_out"]["translation_rms"] == pytest.approx(NOISE_M, rel=0.6)


def test_pivoting_about_only_one_axis_is_refused() -> None:
    rng = np.random.default_rng(1)
    one_axis = Rotation.from_rotvec(np.outer(rng.normal(0, 0.5, 20), [0, 0, 1])).as_matrix()
    found = calibrate(cells.plan("tcp"), pivot_observations(rng, one_axis), None)
    assert found["verdict"] == "degenerate"
    assert found["records"] == {}
    assert "the tool's tip" in found["unobservable"][0]


def test_two_pivot_points_determine_the_same_tool_tip() -> None:
    rng = np.random.default_rng(2)
    rotations = random_rotations(rng, 20)
    places = np.repeat([[0.4, 0.1, 0.2], [-0.3, 0.2, 0.5]], 10, axis=0)
    observations = Observations(
        ids=tuple(str(i) for i in range(20)),
        flange=poses_with_tip_at(rng, rotations, places),
        pivots=("left",) * 10 + ("right",) * 10,
    )
    found = calibrate(cells.plan("tcp"), observations, None)
    np.testing.assert_allclose(found["records"]["tcp"]["transform"]["xyz"], TIP, atol=5e-4)
    assert set(found["records"]["points"]["values"]) == {"pivot.left", "pivot.right"}


def touched_observations(rng: np.random.Generator, fixture: np.ndarray) -> Observations:
    """Twelve points with known coordinates in the fixture are touched with the tool tip."""
    nominal = rng.uniform(-0.2, 0.2, (12, 3))
    flange = poses_with_tip_at(rng, random_rotations(rng, 12), transformed(fixture, nominal))
    ids = tuple(str(i) for i in range(12))
    return Observations(ids=ids, flange=flange, points={"tip": nominal})


def test_touched_points_determine_the_pose_of_the_fixture_and_the_tool_tip() -> None:
    rng = np.random.default_rng(3)
    fixture = rigid(Rotation.from_rotvec([0.1, 0.2, 1.0]).as_matrix(), [0.5, 0.2, 0.1])
    found = calibrate(cells.plan("fixture", "tcp"), touched_observations(rng, fixture), None)
    record = found["records"]["fixture"]
    assert (record["parent"], record["child"]) == ("base", "fixture")
    np.testing.assert_allclose(record["transform"]["xyz"], fixture[:3, 3], atol=8e-4)
    np.testing.assert_allclose(found["records"]["tcp"]["transform"]["xyz"], TIP, atol=8e-4)


def test_a_given_tool_tip_is_not_estimated() -> None:
    rng = np.random.default_rng(4)
    fixture = rigid(Rotation.from_rotvec([0.1, 0.2, 1.0]).as_matrix(), [0.5, 0.2, 0.1])
    plan = cells.plan("fixture", given={"tcp": rigid(np.eye(3), TIP)})
    found = calibrate(plan, touched_observations(rng, fixture), None)
    assert list(found["records"]) == ["fixture"]
    np.testing.assert_allclose(
        found["records"]["fixture"]["transform"]["xyz"], fixture[:3, 3], atol=4e-4
    )


def marker_observations(
    rng: np.random.Generator, places: dict[str, np.ndarray], rows: int = 25
) -> tuple:
    world = cells.pose(rng, 0.5)
    tool = rigid(Rotation.from_rotvec([0.3, 0.2, 1.0]).as_matrix(), [0.02, 0.01, 0.1])
    flange = np.array([rigid(r, rng.uniform(-0.3, 0.3, 3)) for r in random_rotations(rng, rows)])
    points = {
        name: transformed(inverse(world), np.array([transformed(f @ tool, place) for f in flange]))
        + rng.normal(0.0, NOISE_M, (rows, 3))
        for name, place in places.items()
    }
    ids = tuple(str(i) for i in range(rows))
    return Observations(ids=ids, flange=flange, points=points), world, tool


PLACES = {
    "a": np.zeros(3),
    "b": np.array([0.05, 0.0, 0.0]),
    "c": np.array([0.0, 0.08, 0.02]),
    "d": np.array([0.06, 0.05, 0.04]),
}


def test_markers_with_known_places_in_the_tool_determine_its_full_pose() -> None:
    rng = np.random.default_rng(5)
    observations, world, tool = marker_observations(rng, PLACES)
    found = calibrate(cells.plan("tcp", "base_world", points=PLACES), observations, None)
    assert cells.truth_inside(found, "tcp", tool).count(True) >= 5
    assert cells.truth_inside(found, "base_world", inverse(world)).count(True) >= 5


def test_intervals_from_points_contain_the_true_values() -> None:
    inside: list[bool] = []
    for seed in range(10):
        observations, world, tool = marker_observations(np.random.default_rng(seed), PLACES)
        found = calibrate(cells.plan("tcp", "base_world", points=PLACES), observations, None)
        inside += cells.truth_inside(found, "tcp", tool)
        inside += cells.truth_inside(found, "base_world", inverse(world))
    # The 12 intervals of a cell are correlated, so the bound is 88 % instead of 95 %.
    assert 0.88 <= np.mean(inside) < 1.0


def test_points_of_a_mirrored_frame_are_named() -> None:
    rng = np.random.default_rng(5)
    observations, _, _ = marker_observations(rng, PLACES)
    mirrored = {name: values * [-1.0, 1.0, 1.0] for name, values in observations.points.items()}
    found = calibrate(
        cells.plan("tcp", "base_world", points=PLACES), replace(observations, points=mirrored), None
    )
    assert found["verdict"] == "rejected"
    assert "left-handed" in found["suspected"][0]["what"]


def test_a_tip_among_markers_of_unknown_places_is_refused() -> None:
    rng = np.random.default_rng(5)
    observations, _, _ = marker_observations(rng, PLACES)
    with pytest.raises(SpecError, match="several points without a position in the tool"):
        calibrate(cells.plan("tcp", "base_world"), observations, None)


def test_a_marker_that_always_coincides_with_another_is_counted_once() -> None:
    rng = np.random.default_rng(6)
    observations, _, _ = marker_observations(rng, PLACES)
    points = {**observations.points, "d": observations.points["c"]}
    found = calibrate(cells.plan("base_world"), replace(observations, points=points), None)
    assert found["excluded"] == [
        {
            "id": "point.d",
            "why": "markers c and d are at the same place in all 25 rows: one was lost and filled "
            "in; counted once, as c",
        }
    ]


def test_rows_in_which_a_marker_equals_another_are_excluded_for_it() -> None:
    rng = np.random.default_rng(7)
    observations, world, _ = marker_observations(rng, PLACES)
    points = {name: values.copy() for name, values in observations.points.items()}
    points["d"][[2, 9]] = points["c"][[2, 9]]
    found = calibrate(cells.plan("base_world"), replace(observations, points=points), None)
    assert [one["id"] for one in found["excluded"]] == ["2", "9"]
    assert "marker d is left out of this row" in found["excluded"][0]["why"]
    xyz = found["records"]["base_world"]["transform"]["xyz"]
    np.testing.assert_allclose(xyz, inverse(world)[:3, 3], atol=5e-4)


def test_point_sets_are_aligned_without_reflection() -> None:
    rng = np.random.default_rng(8)
    points = rng.normal(size=(6, 3)) * [1.0, 1.0, 1e-9]
    transform = cells.pose(rng)
    np.testing.assert_allclose(kabsch(points, transformed(transform, points)), transform, atol=1e-7)
