"""The D-optimal Fourier series keeps the limits, and is more informative than random motion."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from approved_arms import approved_for_arm, loaded, write_twin

from pytest_twin.excitation.d_optimal import Design
from pytest_twin.excitation.noise import noise_of
from pytest_twin.excitation.read_limits import read_approved
from pytest_twin.identification.regressor.base_parameters import structural_base
from pytest_twin.identification.regressor.regressor import Regressor


def test_the_optimum_keeps_the_limits_and_tells_more_than_random_motion(tmp_path: Path) -> None:
    twin = write_twin(tmp_path, approved_for_arm(mechanisms=["inertia"]))
    realization, read = loaded(twin)
    approved = read_approved(realization, read)
    regressor = Regressor(realization, approved.names)
    std = noise_of(realization, approved).effort
    design = Design(approved, regressor, structural_base(regressor), std)
    optimum = design.optimum(seed=1, starts=2)
    drawn = design.drawn(optimum.coefficients)
    lower, upper = approved.room
    assert np.all(drawn.position >= lower - 1e-9)
    assert np.all(drawn.position <= upper + 1e-9)
    assert np.all(np.abs(drawn.velocity) <= approved.speed * (1.0 + 1e-9))
    assert np.all(np.abs(drawn.acceleration) <= approved.acceleration * (1.0 + 1e-9))
    assert optimum.log_det > max(design.log_det(design.random(seed)) for seed in range(20))
