"""Waves over a joint's way that no grid of starting sizes has."""

from __future__ import annotations

import numpy as np
import pytest
from test_first_order import ELBOW, SHOULDER, Hidden, problem_of

from pytest_twin.diagnosis.first_order.beam_search import ResidualView, candidates
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.harmonic_search import _between, search_harmonics
from pytest_twin.diagnosis.first_order.sensitivities import Linear, Sensitivity, linearize
from pytest_twin.diagnosis.hypothesis import EMPTY, Term

COGGING = Term("cogging", ELBOW)
WAVES = Term("position_dependent_friction", ELBOW)


def _found(hidden: Hidden) -> tuple[dict[Term, Sensitivity], float]:
    """What is found of the plant with something hidden, and the wavenumber of half a wave over the
    elbow's way.
    """
    problem = problem_of("position", hidden)
    linear = linearize(problem, problem.fit, EMPTY)
    assert linear is not None
    left = linear.residual(problem.residuals([EMPTY], problem.fit)[0])
    lengths = bins(problem, problem.fit).lengths
    view = ResidualView(left, np.zeros((*left.shape, 0)), problem.signal_floor, lengths)
    found = {r.term: r for r in search_harmonics(linear, view, candidates(problem))}
    return found, np.pi / float(np.ptp(linear.trajectory.position[..., ELBOW]))


@pytest.mark.parametrize("slots", [33.0, 61.5, 118.0])
def test_slots_are_counted_beyond_the_grid(slots: float) -> None:
    size = {"sine": 0.3, "cosine": 0.1, "harmonic": slots}
    found, half_a_wave = _found({COGGING: size})
    (harmonic,) = found[COGGING].start[2:]
    assert harmonic > max(COGGING.parameters[2].starts)
    # A fit follows from there.
    assert harmonic == pytest.approx(slots, abs=half_a_wave)


@pytest.mark.parametrize("crests", [5.0, 23.0])
def test_crests_of_friction_are_whole_ones(crests: float) -> None:
    size = {"mean": 0.3, "sine": 0.25, "cosine": 0.1, "harmonic": crests}
    found, _ = _found({WAVES: size})
    assert found[WAVES].start[3] == pytest.approx(crests, abs=1.0)
    assert found[WAVES].start[3] % 1.0 == 0.0


def test_the_joint_that_is_furthest_off_alone_is_asked() -> None:
    found, _ = _found({Term("cogging", SHOULDER): {"sine": 1.5, "cosine": 0.0, "harmonic": 40.0}})
    assert {t.joint for t in found} == {SHOULDER}


def test_nothing_is_asked_under_the_floor() -> None:
    found, _ = _found({COGGING: {"sine": 1e-4, "cosine": 0.0, "harmonic": 40.0}})
    assert not found


def test_waves_are_as_far_apart_as_the_way_tells_and_not_beside_the_grid() -> None:
    slots = COGGING.parameters[2]
    short, long = (_between(slots, np.pi / way, 200.0) for way in (0.5, 6.0))
    assert short.min() > max(slots.starts)
    assert np.diff(short).max() == pytest.approx(2.0 * np.pi)
    # Over two turns near, the grid has gaps of its own.
    assert ((long > 21.0) & (long < 23.0)).sum() >= 3
    assert min(abs(k - s) for k in long for s in slots.starts) >= np.pi / 12.0
    crests = WAVES.parameters[3]
    whole = _between(crests, np.pi / 6.0, 200.0)
    assert set(whole) == set(np.arange(1.0, 200.0)) - set(crests.starts)


def test_waves_that_are_shorter_than_what_is_left_say_nothing() -> None:
    """Late by two hundred times the floor, some of 0.03 rad, beside slots of 0.05 rad a wave."""
    slots = {"sine": 0.3, "cosine": 0.1, "harmonic": 118.0}
    found, _ = _found({COGGING: slots, Term("command_delay", ELBOW): {"delay": 0.04}})
    assert COGGING not in found or found[COGGING].start[2] < 60.0


def test_waves_that_change_nothing_are_no_responses(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrist that hardly moves: no wave over its position shows in the prediction."""
    monkeypatch.setattr(Linear, "at_sizes", lambda self, terms, sizes: [])
    found, _ = _found({COGGING: {"sine": 0.3, "cosine": 0.1, "harmonic": 33.0}})
    assert not found
