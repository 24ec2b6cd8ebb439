"""Simple first: a law whose further parameters the recordings do not resolve gives way to less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_physics import FLOOR, LinearPhysics, drawn_physics

from pytest_twin.diagnosis.search.search import Search, SearchOutcome
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

DRY, WAVES = Term("coulomb_friction", 0), Term("position_dependent_friction", 0)
VISCOUS, DIRECTIONAL = Term("viscous_friction", 0), Term("directional_viscous_friction", 0)
SEEDS = range(4)


def friction_of(seed: int, *, wave: float = 0.0, difference: float = 0.0) -> LinearPhysics:
    """Dry and viscous friction of a joint, with candidates that generalize both.

    Args:
        wave: sine amplitude of the dry friction over the position.
        difference: half the difference of viscous friction between the directions of motion.
    """
    physics = drawn_physics(seed, truth={DRY: 0.2, VISCOUS: 0.2})
    rng = np.random.default_rng([seed, 1])
    shape = (*physics.measured.shape, 1)
    # A wave and a difference between directions that move the joint by some noise floors.
    sine, cosine, other = (10.0 * FLOOR * rng.standard_normal(shape) for _ in range(3))
    physics.measured += (wave * sine + difference * other)[..., 0]
    general = {
        WAVES: np.concatenate([physics.responses[DRY], sine, cosine, np.zeros(shape)], axis=-1),
        DIRECTIONAL: np.concatenate([physics.responses[VISCOUS], other], axis=-1),
    }
    return replace(physics, responses={**physics.responses, **general})


def general_start(*terms: Term) -> Hypothesis:
    """Laws at their first starting sizes."""
    return EMPTY.with_terms({t: np.array([p.starts[0] for p in t.parameters]) for t in terms})


def searched(physics: LinearPhysics, start: Hypothesis, rounds: int | None = None) -> SearchOutcome:
    search = Search(physics)
    return search.run([search.simulated(start)], rounds)


@pytest.mark.parametrize("seed", SEEDS)
def test_laws_without_resolved_shape_give_way_to_their_special_cases(seed: int) -> None:
    """Also where a limit ends the search before its first round."""
    start = general_start(WAVES, DIRECTIONAL)
    for rounds in (0, None):
        found = searched(friction_of(seed), start, rounds).incumbent.hypothesis
        assert set(found.terms) == {DRY, VISCOUS}
        assert found.theta == pytest.approx([0.2, 0.2], rel=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_law_with_resolved_shape_stays(seed: int) -> None:
    physics = friction_of(seed, wave=0.5)
    found = searched(physics, general_start(WAVES, DIRECTIONAL))
    assert set(found.incumbent.hypothesis.terms) == {WAVES, VISCOUS}
    physics = friction_of(seed, difference=0.5)
    found = searched(physics, general_start(WAVES, DIRECTIONAL))
    assert set(found.incumbent.hypothesis.terms) == {DRY, DIRECTIONAL}


@pytest.mark.parametrize("seed", SEEDS)
def test_special_cases_are_fitted_before_the_law(seed: int) -> None:
    """A limit right after the first fit leaves the simple law, not the general one."""
    physics = friction_of(seed)
    search = Search(physics)
    start = search.simulated(general_start(WAVES, VISCOUS))
    fits = list[Hypothesis]()
    fit = physics.fit

    def one_fit(
        hypothesis: Hypothesis, residual: np.ndarray, iterations: int, corrected_at: Hypothesis
    ) -> tuple[Hypothesis, np.ndarray, np.ndarray]:
        if fits:
            raise OutOfTime
        fits.append(hypothesis)
        return fit(hypothesis, residual, iterations, corrected_at)

    physics.fit = one_fit  # type: ignore[method-assign]
    found = search.run([start])
    assert set(fits[0].terms) == set(found.incumbent.hypothesis.terms) == {DRY, VISCOUS}
    assert not found.is_complete
