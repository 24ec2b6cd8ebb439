"""Rotations in single precision that represent a joint axis to within 1e-9."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pytest_twin.realization.usd_axes import single_precision_frame


@pytest.mark.parametrize("seed", range(6))
def test_a_rotation_about_the_axis_is_found_that_represents_it_in_single_precision(
    seed: int,
) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    token = np.eye(3)[seed % 3]
    frame = single_precision_frame(token, axis)
    assert (frame == frame.astype(np.float32)).all()
    assert np.linalg.norm(frame) == pytest.approx(1.0, abs=2e-7)
    assert Rotation.from_quat(frame).apply(token) == pytest.approx(axis, abs=5e-10)
    plain = Rotation.align_vectors(axis[None], token[None])[0].as_quat().astype(np.float32)
    assert np.abs(Rotation.from_quat(plain).apply(token) - axis).max() > 1e-9


def test_the_axis_may_be_opposite_to_the_token() -> None:
    token = np.array([0.0, 0.0, 1.0])
    frame = single_precision_frame(token, -token)
    assert Rotation.from_quat(frame).apply(token) == pytest.approx(-token, abs=1e-9)
