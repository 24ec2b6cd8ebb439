"""What the twin knows of a servo is combined with recordings, and gives way to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from nightly import samples
from searched import ProblemPhysics, searched
from simulated_robots import PENDULUM, SERVO, problem_of, with_values

from pytest_twin.diagnosis.intervals import ParameterUncertainty, parameter_uncertainty
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.search.common_effects import set_size
from pytest_twin.diagnosis.servo_priors import (
    CONTRADICTED,
    MOST_SURPRISE,
    CombinedFit,
    PriorUse,
    combine,
    surprise,
)
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.servos.prior import ParameterPrior

GAIN, DRAG, DRY = (
    Term("controller_gain", 0), Term("viscous_friction", 0), Term("coulomb_friction", 0),
)  # fmt: skip
LIMIT = Term("torque_saturation", 0)
XML = PENDULUM.format(drive=SERVO)
KP, KV, FRICTION = 60.0, 2.0, 0.1
"""Of the model, N*m/rad, N*m*s/rad and N*m."""
UNITS = {
    "stiffness": "N*m/rad", "damping": "N*m*s/rad", "viscous": "N*m*s/rad", "friction": "N*m",
    "effort_limit": "N*m", "armature": "kg*m^2",
}  # fmt: skip


def prior(parameter: str, value: float, half: float, joint: str = "a") -> ParameterPrior:
    ends = (value - half, value + half)
    return ParameterPrior("mine", joint, parameter, value, UNITS[parameter], ends)


def fitted_to(
    problem: Problem, start: Hypothesis
) -> tuple[Problem, FittedModel, ParameterUncertainty]:
    here = problem.at(start)
    (residual,) = here.residuals([start], here.fit)
    weights = here.weights(np.mean(residual**2, axis=0))
    (found,) = fit(here, [start], weights, here.fit, iterations=8)
    return here, found, parameter_uncertainty(here, found)


def combined(problem: Problem, start: Hypothesis, *priors: ParameterPrior) -> CombinedFit:
    here, found, uncertainty = fitted_to(problem, start)
    return combine(replace(here, priors=priors), found, uncertainty)


def only(found: CombinedFit) -> PriorUse:
    (use,) = found.uses
    return use


@pytest.fixture(scope="module")
def soft() -> Problem:
    """A servo with 80 % of the model's stiffness, in a joint with 0.15 N*m more dry friction."""
    return problem_of(XML, "position", {GAIN: {"stiffness_error": -0.2}, DRY: {"coulomb": 0.15}})


@pytest.fixture(scope="module")
def damped() -> Problem:
    """0.6 N*m*s/rad more damping, which servo and joint may have in any share."""
    return problem_of(XML, "position", {DRAG: {"coefficient": 0.6}})


GAIN_AND_DRY = {GAIN: {"stiffness_error": -0.1}, DRY: {"coulomb": 0.1}}
GAIN_AND_DRAG = {GAIN: {"damping_error": 0.1}, DRAG: {"coefficient": 0.3}}


def test_without_priors_nothing_changes(soft: Problem) -> None:
    here, found, uncertainty = fitted_to(soft, with_values(soft, GAIN_AND_DRY))
    same = combine(here, found, uncertainty)
    assert same.fitted is found
    assert same.uncertainty is uncertainty
    assert same.uses == ()
    assert surprise(here, found.hypothesis) == 0.0


def test_what_the_recordings_do_not_show_is_as_the_prior_says(damped: Problem) -> None:
    """Only the sum of both dampings moves the robot: the prior of one determines the other."""
    start = with_values(damped, GAIN_AND_DRAG)
    found = combined(damped, start, prior("damping", 2.3, 0.05))
    use = only(found)
    assert use.state == "combined"
    assert use.combined is not None
    assert use.data is None
    assert use.combined == pytest.approx((2.3, 2.25, 2.35), abs=0.01)
    at = found.hypothesis.slice_of(DRAG).start
    scale = damped.scales.value(DRAG.parameters[0], 0)
    # 2.6 + 0.2 in all, of which the servo has 2.3.
    assert found.hypothesis.theta[at] * scale == pytest.approx(0.3, abs=0.03)


def test_strong_recordings_are_not_moved_by_a_wide_prior(soft: Problem) -> None:
    start = with_values(soft, GAIN_AND_DRY)
    here, alone, uncertainty = fitted_to(soft, start)
    wide = prior("stiffness", KP, 30.0), prior("friction", FRICTION, 1.0)
    found = combine(replace(here, priors=wide), alone, uncertainty)
    assert [use.state for use in found.uses] == ["combined", "combined"]
    moved = np.abs(found.hypothesis.theta - alone.hypothesis.theta)
    assert (moved <= 0.05 * uncertainty.half_width + 1e-12).all()
    assert np.allclose(found.uncertainty.half_width, uncertainty.half_width, rtol=0.02)


def test_a_wrong_prior_is_called_contradicted_and_changes_nothing(soft: Problem) -> None:
    start = with_values(soft, GAIN_AND_DRY)
    here, alone, uncertainty = fitted_to(soft, start)
    wrong = prior("stiffness", KP, 1.0)
    found = combine(replace(here, priors=(wrong,)), alone, uncertainty)
    use = only(found)
    assert use.state == "contradicted"
    assert use.distance is not None
    assert use.distance > CONTRADICTED
    assert use.data is not None
    assert use.data[0] == pytest.approx(0.8 * KP, rel=0.02)
    assert "contradict" in use.to_json()["why"]
    assert found.fitted is alone
    assert found.uncertainty is uncertainty


def test_one_wrong_prior_does_not_take_a_right_one_with_it(soft: Problem) -> None:
    found = combined(
        soft, with_values(soft, GAIN_AND_DRY), prior("stiffness", KP, 1.0),
        prior("friction", 0.25, 0.01),
    )  # fmt: skip
    assert [use.state for use in found.uses] == ["contradicted", "combined"]


def test_a_parameter_that_no_effect_corrects_keeps_the_models_value(soft: Problem) -> None:
    start = with_values(soft, GAIN_AND_DRY)
    use = only(combined(soft, start, prior("armature", 0.03, 0.001)))
    assert (use.state, use.model) == ("not_estimated", pytest.approx(0.02))
    assert only(combined(soft, start, prior("effort_limit", 3.0, 0.1))).model is None


def limit_of(true: float, *known: float) -> PriorUse:
    problem = problem_of(XML, "position", {LIMIT: {"inverse_limit": 1.0 / true}})
    start = with_values(problem, {LIMIT: {"inverse_limit": 0.95 / true}})
    return only(combined(problem, start, prior("effort_limit", *known)))


def test_a_limit_of_the_effort_is_compared_as_a_limit() -> None:
    right, wrong = limit_of(2.0, 2.1, 0.2), limit_of(2.0, 2.8, 0.2)
    assert [right.state, wrong.state] == ["combined", "contradicted"]
    for use in (right, wrong):
        assert use.data is not None
        assert use.data[1] <= 2.0 <= use.data[2]


def test_a_limit_that_the_motion_does_not_reach_is_as_the_prior_says() -> None:
    use = limit_of(6.0, 8.0, 0.5)
    assert use.combined is not None
    assert use.combined == pytest.approx((8.0, 7.5, 8.5), abs=0.1)


@pytest.mark.parametrize(
    ("joint", "parameter"), [("elsewhere", "stiffness")], ids=["a joint without recordings"]
)
def test_a_prior_of_another_joint_says_nothing(soft: Problem, joint: str, parameter: str) -> None:
    start = with_values(soft, GAIN_AND_DRY)
    assert combined(soft, start, prior(parameter, KP, 1.0, joint)).uses == ()


def test_a_torque_drive_has_no_gain_to_compare() -> None:
    problem = problem_of(PENDULUM.format(drive='<motor joint="a"/>'), "effort", {})
    use = only(combined(problem, EMPTY, prior("stiffness", KP, 1.0)))
    assert use.state == "not_comparable"
    assert "no position servo" in use.why


def test_a_prior_enters_the_score_up_to_its_limit(soft: Problem) -> None:
    known = replace(soft, priors=(prior("stiffness", KP, 6.0),))
    near, far = (with_values(soft, {GAIN: {"stiffness_error": error}}) for error in (-0.05, -0.9))
    # 3 N*m/rad with a standard deviation of 6 / 1.96.
    assert surprise(known, near) == pytest.approx(0.5 * 0.98**2, rel=0.01)
    assert surprise(known, far) == MOST_SURPRISE
    assert set_size(known, near, {}).surprise == surprise(known, near)
    comparison = searched(soft, rounds=0).comparison
    plain, with_prior = (comparison.penalty(set_size(p, near, {})) for p in (soft, known))
    assert with_prior == plain + surprise(known, near)


@pytest.mark.nightly
def test_a_wrong_prior_hides_no_effect_from_the_search(soft: Problem) -> None:
    """A stiffness that is 20 % off is named, although the prior excludes it."""
    known = replace(soft, priors=(prior("stiffness", KP, 0.1), prior("friction", FRICTION, 0.01)))
    found = searched(known).incumbent.hypothesis
    assert set(found.terms) == set(searched(soft).incumbent.hypothesis.terms) == {GAIN, DRY}


def test_the_physics_of_the_search_has_the_priors(soft: Problem) -> None:
    known = ProblemPhysics(replace(soft, priors=(prior("stiffness", KP, 1.0),)))
    away = with_values(soft, {GAIN: {"stiffness_error": -0.2}})
    assert known.size(away).surprise == MOST_SURPRISE


DEVIATION = 0.003
"""Of the servo's damping, N*m*s/rad: as much as recordings of 6 s leave open."""


@pytest.mark.parametrize("seeds", samples(60, always=tuple(range(12))))
def test_intervals_with_a_prior_contain_the_true_values(seeds: tuple[int, ...]) -> None:
    """True dampings are drawn from the prior, all else at random."""
    outside, narrower, count = 0, 0, len(seeds)
    for seed in seeds:
        random = np.random.default_rng(seed)
        damping = float(random.normal(KV, DEVIATION))
        hidden = {
            GAIN: {
                "damping_error": damping / KV - 1.0,
                "stiffness_error": float(random.uniform(-0.2, 0.2)),
            },
            DRY: {"coulomb": float(random.uniform(0.05, 0.2))},
        }
        problem = problem_of(XML, "position", hidden, seed=seed)
        start = with_values(problem, GAIN_AND_DRY)
        use = only(combined(problem, start, prior("damping", KV, 1.96 * DEVIATION)))
        estimate = use.combined or use.data
        assert estimate is not None
        assert use.data is not None
        outside += not estimate[1] <= damping <= estimate[2]
        narrower += estimate[2] - estimate[1] < 0.95 * (use.data[2] - use.data[1])
    assert outside <= max(0.1 * count, 1.0), (outside, count)
    assert narrower > 0.5 * count


@pytest.mark.parametrize("seeds", samples(60, always=tuple(range(4))))
def test_what_only_the_prior_decides_is_inside_its_interval(seeds: tuple[int, ...]) -> None:
    """The recordings show the sum of both dampings alone."""
    outside = 0
    for seed in seeds:
        random = np.random.default_rng(seed)
        damping = float(random.normal(KV, 0.1))
        viscous = float(random.uniform(0.1, 0.6))
        hidden = {GAIN: {"damping_error": damping / KV - 1.0}, DRAG: {"coefficient": viscous}}
        problem = problem_of(XML, "position", hidden, seed=seed)
        start = with_values(problem, GAIN_AND_DRAG)
        found = combined(problem, start, prior("damping", KV, 1.96 * 0.1))
        place = found.hypothesis.slice_of(DRAG).start
        scale = problem.scales.value(DRAG.parameters[0], 0)
        error = viscous - scale * found.hypothesis.theta[place]
        outside += abs(error) > scale * found.uncertainty.half_width[place]
    assert outside <= max(0.1 * len(seeds), 1.0), outside
