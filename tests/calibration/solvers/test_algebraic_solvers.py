"""Common interface of OpenCV's algebraic hand-eye solvers."""

import numpy as np
import pytest
from drawn_hand_eye import random_hand_eye

from pytest_twin.calibration.solvers.algebraic import HAND_EYE, ROBOT_WORLD, solve_all


@pytest.mark.parametrize("mount", ["hand", "world"])
def test_every_solver_finds_both_transforms_from_exact_poses(mount):
    flange, seen, hand_eye, robot_world = random_hand_eye(mount, 12, seed=3)
    solved = solve_all(flange, seen, mount)
    assert set(solved) == {*HAND_EYE, *ROBOT_WORLD}
    for name, one in solved.items():
        assert one.failed == "", name
        np.testing.assert_allclose(one.hand_eye, hand_eye, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(one.robot_world, robot_world, atol=1e-6, err_msg=name)


def test_each_solver_name_selects_a_different_method():
    # OpenCV ignores a method given as positional argument; all results would be the same.
    flange, seen, _, _ = random_hand_eye("hand", 12, seed=3, noise=2e-3)
    places = [one.hand_eye[:3, 3] for one in solve_all(flange, seen, "hand").values()]
    for i, place in enumerate(places):
        for other in places[:i]:
            assert np.linalg.norm(place - other) > 1e-7


def test_a_solver_reports_if_it_finds_no_transform():
    flange, seen, _, _ = random_hand_eye("hand", 6, seed=1)
    still = solve_all(np.repeat(flange[:1], 6, axis=0), np.repeat(seen[:1], 6, axis=0), "hand")
    assert any(one.failed for one in still.values())
    for one in still.values():
        assert one.failed or np.isfinite(one.hand_eye).all()


def test_every_solver_reports_that_two_poses_are_too_few():
    flange, seen, _, _ = random_hand_eye("hand", 2, seed=1)
    assert {one.failed for one in solve_all(flange, seen, "hand").values()} == {"needs 3 poses"}
