"""Bodies that carry point masses, against Pinocchio's spatial inertias."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pytest_twin.effects.point_mass import with_point_mass

ROWS = 5


@given(seed=st.integers(0, 10_000))
def test_body_with_point_mass_has_the_summed_spatial_inertia(seed: int) -> None:
    random = np.random.default_rng(seed)
    mass, added = random.uniform(0.1, 3.0, (2, ROWS))
    center, at = random.uniform(-0.4, 0.4, (2, ROWS, 3))
    # A body's own moments obey the triangle inequality.
    second = random.uniform(1e-3, 0.1, (ROWS, 3))
    moments = second.sum(axis=1, keepdims=True) - second
    turns = [pin.Quaternion(*q / np.linalg.norm(q)) for q in random.standard_normal((ROWS, 4))]
    quat = np.array([[q.w, q.x, q.y, q.z] for q in turns])
    total, both, values, axes = with_point_mass(mass, center, moments, quat, added, at)
    for i, turn in enumerate(turns):
        frame = turn.toRotationMatrix()
        body = pin.Inertia(mass[i], center[i], frame @ np.diag(moments[i]) @ frame.T)
        whole = body + pin.Inertia(added[i], at[i], np.zeros((3, 3)))
        turned = pin.Quaternion(*axes[i]).toRotationMatrix()
        assert np.isclose(total[i], whole.mass)
        assert_allclose(both[i], whole.lever, atol=1e-12)
        assert_allclose(turned @ np.diag(values[i]) @ turned.T, whole.inertia, atol=1e-12)
        assert np.linalg.det(turned) > 0.0
