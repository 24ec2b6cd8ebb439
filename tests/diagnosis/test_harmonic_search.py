"""Search for wavenumbers over the joint position that are not in the grid of starting sizes."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, SHOULDER, Hidden, problem_of

from pytest_twin.diagnosis.first_order.beam_search import ResidualView, candidates
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.harmonic_search import (
    search_harmonics,
    wavenumbers_to_search,
)
from pytest_twin.diagnosis.first_order.sensitivities import Linearization, Sensitivity, linearize
from pytest_twin.estimation.hypothesis import EMPTY, Term

COGGING = Term("cogging", ELBOW)
WAVES = Term("position_dependent_friction", ELBOW)


def _searched(hidden: Hidden) -> tuple[dict[Term, Sensitivity], float]:
    """Sensitivities that the search returns for a hidden effect, and the wavenumber of half a wave
    over the elbow's travel.
    """
    problem = problem_of("position", hidden)
    linear = linearize(problem, problem.fit, EMPTY)
    assert linear is not None
    left = linear.residual(problem.residuals([EMPTY], problem.fit)[0])
    lengths = bins(problem, problem.fit).lengths
    view = ResidualView(left, np.zeros((*left.shape, 0)), problem.signal_floor, lengths)
    found = {r.term: r for r in search_harmonics(linear, view, candidates(problem))}
    return found, np.pi / float(np.ptp(linear.trajectory.position[..., ELBOW]))


@pytest.mark.parametrize("wavenumber", [33.0, 61.5, 118.0])
def test_cogging_with_a_wavenumber_outside_the_grid_is_found(wavenumber: float) -> None:
    size = {"sine": 0.3, "cosine": 0.1, "harmonic": wavenumber}
    found, half_wave = _searched({COGGING: size})
    (harmonic,) = found[COGGING].start[2:]
    assert harmonic > max(COGGING.parameters[2].starts)
    # A fit converges from this distance.
    assert harmonic == pytest.approx(wavenumber, abs=half_wave)


@pytest.mark.parametrize("waves", [5.0, 23.0])
def test_position_dependent_friction_has_an_integer_wavenumber(waves: float) -> None:
    size = {"mean": 0.3, "sine": 0.25, "cosine": 0.1, "harmonic": waves}
    found, _ = _searched({WAVES: size})
    assert found[WAVES].start[3] == pytest.approx(waves, abs=1.0)
    assert found[WAVES].start[3] % 1.0 == 0.0


def test_only_the_joint_with_the_largest_residual_is_searched() -> None:
    found, _ = _searched(
        {Term("cogging", SHOULDER): {"sine": 1.5, "cosine": 0.0, "harmonic": 40.0}}
    )
    assert {t.joint for t in found} == {SHOULDER}


def test_no_wave_is_searched_in_a_residual_below_the_noise_floor() -> None:
    found, _ = _searched({COGGING: {"sine": 1e-4, "cosine": 0.0, "harmonic": 40.0}})
    assert not found


def test_wavenumbers_are_spaced_according_to_the_travel_and_omit_those_of_the_grid() -> None:
    wavenumber = COGGING.parameters[2]
    short, long = (wavenumbers_to_search(wavenumber, np.pi / way, 200.0) for way in (0.5, 6.0))
    assert short.min() > max(wavenumber.starts)
    assert np.diff(short).max() == pytest.approx(2.0 * np.pi)
    # With a large travel, the spacing is smaller than the gaps of the grid.
    assert ((long > 21.0) & (long < 23.0)).sum() >= 3
    assert min(abs(k - s) for k in long for s in wavenumber.starts) >= np.pi / 12.0
    friction_waves = WAVES.parameters[3]
    whole = wavenumbers_to_search(friction_waves, np.pi / 6.0, 200.0)
    assert set(whole) == set(np.arange(1.0, 200.0)) - set(friction_waves.starts)


def test_waves_shorter_than_the_prediction_error_are_not_searched() -> None:
    """A command delay causes an error of 0.03 rad; a wave of the slots is 0.05 rad long."""
    cogging = {"sine": 0.3, "cosine": 0.1, "harmonic": 118.0}
    found, _ = _searched({COGGING: cogging, Term("command_delay", ELBOW): {"delay": 0.04}})
    assert COGGING not in found or found[COGGING].start[2] < 60.0


def test_waves_that_do_not_change_the_prediction_are_no_candidates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As at a joint that hardly moves: no wave over its position changes the prediction."""
    monkeypatch.setattr(Linearization, "at_sizes", lambda self, terms, sizes: [])
    found, _ = _searched({COGGING: {"sine": 0.3, "cosine": 0.1, "harmonic": 33.0}})
    assert not found
