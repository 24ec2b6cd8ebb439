"""Sets of effects with the same prediction share the confidence; the likelier set is selected."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.equivalent_sets import (
    Allowed,
    AlternativeSet,
    ComparedSets,
    compare_sets,
    removed_subsets,
    without_mere_additions,
)
from pytest_twin.diagnosis.equivalent_settings import EQUIVALENT
from pytest_twin.diagnosis.first_order.sensitivities import starting_grid
from pytest_twin.diagnosis.problem import Problem, joint_scales, replay_nominal
from pytest_twin.diagnosis.replacement import replace_closest_known
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.pruning import PrunedModel
from pytest_twin.diagnosis.search.scored_model import SelectedModel
from pytest_twin.diagnosis.shared_confidence import share_confidence
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.deadline import CHECK, OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term, effect_values
from pytest_twin.estimation.score import tempered_samples

NOISE, SAMPLE, SECONDS = 2e-4, 0.01, 3.0
ROBOT, FIRST, SECOND = -1, 0, 1
COMMAND_DELAY, SENSOR_DELAY = Term("command_delay", FIRST), Term("sensor_delay", ROBOT)
CONSTANT = Term("torque_constant", FIRST)
LOAD, DRAG, DRY = (
    Term("payload", ROBOT), Term("viscous_friction", FIRST), Term("coulomb_friction", FIRST),
)  # fmt: skip
TILT, ENCODER_BIAS = Term("base_tilt", ROBOT), Term("encoder_bias", FIRST)

PENDULUM = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".2" armature=".02" frictionloss=".1"/>
<inertial pos="0 0 -.2" mass="1" diaginertia=".01 .01 .001"/>
</body></worldbody><actuator>{drive}</actuator></mujoco>
"""
SERVO, MOTOR = '<position joint="a" kp="60" kv="2"/>', '<motor joint="a"/>'
SLIDER = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" type="slide" axis="1 0 0" damping="20"/>
<inertial pos=".1 .05 .02" mass="2" diaginertia=".01 .02 .03"/>
</body></worldbody><actuator><position joint="a" kp="2000" kv="60"/></actuator></mujoco>
"""
PLANAR = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".5" armature=".05"/>
<inertial pos="0 0 .2" mass="2" diaginertia=".03 .03 .002"/>
<body pos="0 0 .4"><joint name="b" axis="0 1 0" damping=".3" armature=".03"/>
<inertial pos="0 0 .15" mass="1" diaginertia=".01 .01 .001"/></body></body></worldbody>
<actuator><position joint="a" kp="150" kv="8"/><position joint="b" kp="80" kv="4"/></actuator>
</mujoco>
"""


def command(mode: str, joints: int, seed: int) -> FloatArray:
    """(samples, joints) smooth commands that begin at rest, rad or N*m."""
    rng = np.random.default_rng(seed)
    t = SAMPLE * np.arange(round(SECONDS / SAMPLE))
    size = 0.4 if mode == "position" else 2.5
    wave = sum(
        np.sin(2 * np.pi * t[:, None] * rng.uniform(0.4, 1.6, joints) + rng.uniform(0, 6, joints))
        for _ in range(3)
    )
    return np.asarray(size / 2 * wave * np.minimum(t / 0.4, 1.0)[:, None])


def with_values(problem: Problem, hidden: dict[Term, dict[str, float]]) -> Hypothesis:
    h = EMPTY
    for term, values in hidden.items():
        h = h.with_term(
            term,
            np.array([
                values.get(p.name, p.absent_value * problem.scales.value(p, term.joint))
                / problem.scales.value(p, term.joint)
                for p in term.parameters
            ]),
        )  # fmt: skip
    return h


def problem_of(xml: str, mode: str, hidden: dict[Term, dict[str, float]]) -> Problem:
    """Two fit recordings of a robot with hidden effects, which the package itself simulates."""
    model = mujoco.MjModel.from_xml_string(xml)
    joints = tuple(model.joint(i).name for i in range(model.njnt))
    time: FloatArray = SAMPLE * np.arange(round(SECONDS / SAMPLE), dtype=np.float64)
    still = np.zeros(len(joints))
    segments = [
        Segment(
            trial=k, model=model, mode=mode, start=0.0, time=time,
            position=command(mode, len(joints), k), velocity=None, effort=None,
            command_time=time, command=command(mode, len(joints), k),
            initial_position=still, initial_velocity=still,
        )
        for k in range(2)
    ]  # fmt: skip
    simulator = BatchSimulator(segments, joints, threads=1)
    scales = joint_scales(simulator, replay_nominal(simulator))
    noise = np.full(len(joints), NOISE)
    problem = Problem(simulator, np.arange(2), np.zeros(0, np.int64), noise, scales)
    rng = np.random.default_rng(1)
    values = effect_values([with_values(problem, hidden)] * 2, len(joints), scales)
    measured = [
        replace(s, position=p.position + NOISE * rng.standard_normal(p.position.shape))
        for s, p in zip(segments, simulator.simulate(np.arange(2), values), strict=True)
    ]
    simulator = BatchSimulator(measured, joints, threads=1)
    out = Problem(simulator, np.arange(2), np.zeros(0, np.int64), noise, scales)
    return out.at(EMPTY)


def compared(problem: Problem, start: Hypothesis) -> ComparedSets:
    comparison = ModelComparison(problem)
    best = comparison.fit_to_convergence(
        comparison.fit_to_convergence(comparison.score_without_fit(start))
    )
    return compare_sets(comparison, best.hypothesis)


def confidences(problem: Problem, found: ComparedSets) -> SelectedModel:
    nominal = ModelComparison(problem).nominal
    return share_confidence(SelectedModel(found.best, nominal), found)


@pytest.mark.parametrize(
    ("xml", "mode"),
    [(PENDULUM.format(drive=SERVO), "position"), (SLIDER, "position")],
    ids=["hinge", "slide"],
)
def test_command_delay_and_sensor_delay_of_one_joint_share_the_confidence(
    xml: str, mode: str
) -> None:
    problem = problem_of(xml, mode, {COMMAND_DELAY: {"delay": 0.02}})
    found = compared(problem, with_values(problem, {SENSOR_DELAY: {"delay": 0.018}}))
    selected = confidences(problem, found)
    (term,) = found.best.hypothesis.terms
    (first, *_) = selected.sets[term]
    assert {term, *first.new} == {COMMAND_DELAY, SENSOR_DELAY}
    assert selected.confidence[term] == pytest.approx(0.5, abs=0.15)
    assert first.confidence == pytest.approx(0.5, abs=0.15)
    assert found.simulations <= EQUIVALENT.most_simulations


@pytest.mark.parametrize("hidden", ["commands", "readings"])
def test_late_commands_of_all_joints_and_late_readings_share_the_confidence(hidden: str) -> None:
    both = (COMMAND_DELAY, Term("command_delay", SECOND))
    late = {t: {"delay": 0.02} for t in (both if hidden == "commands" else (SENSOR_DELAY,))}
    problem = problem_of(PLANAR, "position", late)
    found = compared(problem, with_values(problem, {SENSOR_DELAY: {"delay": 0.019}}))
    selected = confidences(problem, found)
    assert found.best.hypothesis.terms == (SENSOR_DELAY,)
    (first, *_) = selected.sets[SENSOR_DELAY]
    assert set(first.new) == set(both)
    assert selected.confidence[SENSOR_DELAY] == pytest.approx(0.5, abs=0.15)
    assert first.confidence == pytest.approx(0.5, abs=0.15)


def test_late_commands_of_one_joint_of_two_are_no_late_readings() -> None:
    problem = problem_of(PLANAR, "position", {COMMAND_DELAY: {"delay": 0.02}})
    found = compared(problem, with_values(problem, {COMMAND_DELAY: {"delay": 0.019}}))
    assert found.best.hypothesis.terms == (COMMAND_DELAY,)
    assert confidences(problem, found).confidence[COMMAND_DELAY] > 0.95


class Limit:
    """A limit on the number of times that a search asks whether its time is over."""

    def __init__(self, most: int) -> None:
        self.most, self.asked = most, 0

    def __call__(self) -> None:
        self.asked += 1
        if self.asked > self.most:
            raise OutOfTime

    def compared(self, problem: Problem, allowed: Allowed = lambda h: True) -> ComparedSets:
        token = CHECK.set(self)
        try:
            start = with_values(problem, {SENSOR_DELAY: {"delay": 0.02}})
            return compare_sets(ModelComparison(problem), start, allowed)
        finally:
            CHECK.reset(token)


def test_sets_share_the_confidence_by_the_fit_so_far_if_the_time_ends() -> None:
    problem = problem_of(PENDULUM.format(drive=SERVO), "position", {COMMAND_DELAY: {"delay": 0.02}})
    limit = Limit(10**6)
    found = limit.compared(problem)
    while found.is_complete:
        limit = Limit(limit.asked - 1)
        found = limit.compared(problem)
    assert found.best.hypothesis.terms == (SENSOR_DELAY,)
    assert all(s.evidence <= 0.0 for s in found.sets)
    assert found.sets[0].terms == {COMMAND_DELAY}
    assert confidences(problem, found).confidence[SENSOR_DELAY] == pytest.approx(0.5, abs=0.15)
    # A set that may not be reported is no result of a comparison in part.
    with pytest.raises(OutOfTime):
        Limit(limit.most).compared(problem, lambda h: SENSOR_DELAY not in h.terms)


def test_one_effect_is_preferred_to_three_with_the_same_prediction_as_its_alternative() -> None:
    problem = problem_of(
        PENDULUM.format(drive=MOTOR), "effort", {CONSTANT: {"relative_error": -0.14}}
    )
    start = with_values(
        problem,
        {
            LOAD: {"mass": 0.093, "distance": 0.35, "form": 0.0},
            DRAG: {"coefficient": 0.0326},
            DRY: {"coulomb": 0.0163},
        },
    )
    found = compared(problem, start)
    assert found.best.hypothesis.terms == (CONSTANT,)
    selected = confidences(problem, found)
    assert selected.confidence[CONSTANT] > 0.9
    assert any(set(a.new) == {LOAD, DRAG, DRY} for a in selected.sets[CONSTANT])


def test_base_tilt_and_encoder_bias_share_the_confidence_for_parallel_joint_axes() -> None:
    problem = problem_of(PLANAR, "position", {TILT: {"pitch": 0.06}})
    start = with_values(problem, {ENCODER_BIAS: {"bias": -0.06, "in_loop": 1.0}})
    found = compared(problem, start)
    selected = confidences(problem, found)
    both = {found.best.hypothesis.terms, *(tuple(s.model.hypothesis.terms) for s in found.sets)}
    assert {(TILT,), (ENCODER_BIAS,)} <= both
    assert 0.1 < selected.confidence[found.best.hypothesis.terms[0]] < 0.95


def test_an_impossible_set_is_replaced_by_the_likeliest_possible_one() -> None:
    problem = problem_of(PENDULUM.format(drive=SERVO), "position", {COMMAND_DELAY: {"delay": 0.02}})
    comparison = ModelComparison(problem)
    start = with_values(problem, {SENSOR_DELAY: {"delay": 0.02}})
    found = compare_sets(comparison, start, lambda h: SENSOR_DELAY not in h.terms)
    assert found.best.hypothesis.terms == (COMMAND_DELAY,)


def test_subsets_begin_with_single_effects_and_contain_all_effects_of_a_joint() -> None:
    terms = (LOAD, DRAG, DRY, Term("armature", SECOND))
    found = removed_subsets(terms)
    assert found[:4] == [(t,) for t in terms]
    assert (LOAD, DRAG, DRY) in found
    assert (DRAG, Term("armature", SECOND)) not in found


def test_model_error_does_not_average_out_within_a_recording() -> None:
    effective, floor = np.array([400.0]), np.array([1.0])
    assert tempered_samples(effective, floor**2, floor, 4, 1)[0] == pytest.approx(400.0)
    # Far above the floor, each recording counts as one sample.
    assert tempered_samples(effective, (100 * floor) ** 2, floor, 4, 1)[0] == pytest.approx(
        4.0, rel=0.05
    )


def test_the_model_error_of_a_position_applies_to_the_effort_of_its_joint() -> None:
    # Positions of two joints, then their efforts; only the first position is far above its floor.
    floor, effective = np.ones(4), np.full(4, 400.0)
    samples = tempered_samples(effective, np.array([1e4, 1.0, 1.0, 1.0]), floor, 4, 2)
    assert samples == pytest.approx([4.0, 400.0, 4.0, 400.0], rel=0.05)


def test_the_confidence_of_an_effect_follows_from_the_odds_of_the_sets_without_it() -> None:
    problem = problem_of(SLIDER, "position", {})
    comparison = ModelComparison(problem)
    h = EMPTY.with_term(COMMAND_DELAY, starting_grid(COMMAND_DELAY)[0][0])
    (best,) = comparison.fit_models([h], comparison.nominal, 0)
    no_alternatives = ComparedSets(best, (), 1.0, 0.0)
    known = SelectedModel(
        best, comparison.nominal, {COMMAND_DELAY: 0.8}, {COMMAND_DELAY: [(DRAG, 0.2)]}
    )
    assert share_confidence(known, no_alternatives).confidence[COMMAND_DELAY] == pytest.approx(0.8)
    # Model error halves the evidence: odds of 1/4 become 1/2.
    halved = share_confidence(known, replace(no_alternatives, tempering=0.5))
    assert halved.confidence[COMMAND_DELAY] == pytest.approx(2 / 3)
    assert halved.sets[COMMAND_DELAY][0].new == (DRAG,)


def test_an_unlikely_alternative_keeps_its_tempered_evidence() -> None:
    """5,000 nats tempered by 0.002 are 10 nats, although exp(-5000) is zero in floating point."""
    problem = problem_of(SLIDER, "position", {})
    comparison = ModelComparison(problem)
    h = EMPTY.with_term(COMMAND_DELAY, starting_grid(COMMAND_DELAY)[0][0])
    (best,) = comparison.fit_models([h], comparison.nominal, 0)
    selected = SelectedModel(best, comparison.nominal)
    removed = (COMMAND_DELAY,)
    selected.weigh({(removed, DRAG): -5000.0, (removed, DRY): -5000.0, (removed, None): -9000.0})
    shared = share_confidence(selected, ComparedSets(best, (), 0.002, 0.0))
    odds = 2 * np.exp(-10.0) + np.exp(-18.0)
    assert shared.confidence[COMMAND_DELAY] == pytest.approx(1.0 / (1.0 + odds))


def test_evidence_of_the_linearized_motion_alone_does_not_lower_a_confidence() -> None:
    problem = problem_of(SLIDER, "position", {})
    comparison = ModelComparison(problem)
    h = EMPTY.with_term(COMMAND_DELAY, starting_grid(COMMAND_DELAY)[0][0])
    (best,) = comparison.fit_models([h], comparison.nominal, 0)
    known = SelectedModel(
        best, comparison.nominal, {COMMAND_DELAY: 0.2}, {COMMAND_DELAY: [(DRAG, 0.8)]},
        evidence={COMMAND_DELAY: {DRAG: 50.0}}, not_simulated=frozenset({COMMAND_DELAY}),
    )  # fmt: skip
    alone = ComparedSets(best, (), 1.0, 0.0)
    assert share_confidence(known, alone).confidence[COMMAND_DELAY] == pytest.approx(0.2)
    simulated = replace(known, not_simulated=frozenset())
    assert share_confidence(simulated, alone).confidence[COMMAND_DELAY] < 1e-9


def test_a_general_law_is_no_alternative_to_its_special_case() -> None:
    problem = problem_of(PENDULUM.format(drive=SERVO), "position", {})
    comparison = ModelComparison(problem)
    general = Term("asymmetric_friction", FIRST)
    own = with_values(problem, {DRY: {"coulomb": 0.1}})
    other = with_values(problem, {general: {"coulomb": 0.1}})
    best, rival = comparison.fit_models([own, other], comparison.nominal, 0)
    found = ComparedSets(best, (AlternativeSet(rival, 0.0, 0.0),), 1.0, 0.0)
    selected = share_confidence(SelectedModel(best, comparison.nominal), found)
    assert selected.confidence[DRY] == pytest.approx(1.0)
    # The special case is an alternative to the general law.
    found = ComparedSets(rival, (AlternativeSet(best, 0.0, 0.0),), 1.0, 0.0)
    assert share_confidence(SelectedModel(rival, comparison.nominal), found).confidence[
        general
    ] == pytest.approx(0.5)


def test_effects_of_independent_causes_keep_the_confidence_that_each_has_alone() -> None:
    """Late readings explain late commands, and two general laws contain dry friction.

    Combinations of both are the same alternatives, not further ones.
    """
    problem = problem_of(PENDULUM.format(drive=SERVO), "position", {})
    comparison = ModelComparison(problem)

    def shared(own: tuple[Term, ...], *others: tuple[Term, ...]) -> dict[Term, float]:
        fitted = comparison.fit_models(
            [with_values(problem, {t: {} for t in terms}) for terms in (own, *others)],
            comparison.nominal,
            0,
        )
        best, *rivals = fitted
        sets = tuple(AlternativeSet(rival, 0.0, 0.0) for rival in rivals)
        selected = SelectedModel(best, comparison.nominal)
        return share_confidence(selected, ComparedSets(best, sets, 1.0, 0.0)).confidence

    asymmetric, stribeck = (Term(e, FIRST) for e in ("asymmetric_friction", "stribeck_friction"))
    friction_alone = shared((DRY,), (asymmetric,), (stribeck,))
    delay_alone = shared((COMMAND_DELAY,), (SENSOR_DELAY,))
    both = shared(
        (DRY, COMMAND_DELAY),
        *((law, COMMAND_DELAY) for law in (asymmetric, stribeck)),
        *((law, SENSOR_DELAY) for law in (DRY, asymmetric, stribeck)),
    )
    assert friction_alone == pytest.approx({DRY: 1.0})
    assert delay_alone == pytest.approx({COMMAND_DELAY: 0.5})
    assert both == pytest.approx(friction_alone | delay_alone)


def test_a_general_law_at_another_joint_is_an_alternative() -> None:
    problem = problem_of(PLANAR, "position", {})
    comparison = ModelComparison(problem)
    elsewhere = Term("asymmetric_friction", SECOND)
    best, rival = comparison.fit_models(
        [with_values(problem, {t: {}}) for t in (DRY, elsewhere)], comparison.nominal, 0
    )
    sets = ComparedSets(best, (AlternativeSet(rival, 0.0, 0.0),), 1.0, 0.0)
    selected = share_confidence(SelectedModel(best, comparison.nominal), sets)
    assert selected.confidence[DRY] == pytest.approx(0.5)


def rejected(
    problem: Problem, chosen: dict[Term, dict[str, float]]
) -> tuple[ModelComparison, SelectedModel, PrunedModel]:
    """A fitted set of effects, all of which pruning rejects."""
    comparison = ModelComparison(problem)
    best = comparison.fit_to_convergence(comparison.score_without_fit(with_values(problem, chosen)))
    nothing = comparison.score_without_fit(EMPTY).fitted
    selected = SelectedModel(best, comparison.nominal)
    return comparison, selected, PrunedModel(nothing, [], ["rejected"], closest=tuple(chosen))


@pytest.fixture(scope="module")
def delayed() -> Problem:
    return problem_of(PENDULUM.format(drive=SERVO), "position", {COMMAND_DELAY: {"delay": 0.02}})


def test_a_rejected_effect_is_replaced_by_one_that_explains_as_much(delayed: Problem) -> None:
    comparison, selected, pruned = rejected(delayed, {SENSOR_DELAY: {"delay": 0.02}})
    chosen, left = replace_closest_known(delayed, comparison, selected, pruned)
    assert left.fitted.hypothesis.terms == (COMMAND_DELAY,)
    assert left.fitted.hypothesis.theta[0] * delayed.scales.value(
        COMMAND_DELAY.parameters[0], COMMAND_DELAY.joint
    ) == pytest.approx(0.02, abs=1e-3)
    assert chosen.confidence[COMMAND_DELAY] > 0.5
    assert left.notes == ["rejected"]
    assert left.closest == (SENSOR_DELAY,)


def test_a_rejected_effect_is_not_replaced_by_one_that_explains_far_less(delayed: Problem) -> None:
    comparison, selected, pruned = rejected(delayed, {COMMAND_DELAY: {"delay": 0.02}})
    pruned.closest = (COMMAND_DELAY, SENSOR_DELAY)
    _, left = replace_closest_known(delayed, comparison, selected, pruned)
    assert left is pruned


def test_no_replacement_is_simulated_if_pruning_rejected_no_closest_effect(
    delayed: Problem,
) -> None:
    comparison, selected, pruned = rejected(delayed, {DRAG: {"coefficient": 0.1}})
    pruned.closest = ()
    before = delayed.simulated_steps
    assert replace_closest_known(delayed, comparison, selected, pruned) == (selected, pruned)
    assert delayed.simulated_steps == before


def test_an_alternative_set_keeps_the_other_effects() -> None:
    """An alternative to the main effect contains the minor effect too."""
    main, rival, minor = (Term(e, 0) for e in ("command_delay", "actuator_lag", "cogging"))
    sets = [
        (99.0, EMPTY.with_term(rival, np.zeros(len(rival.parameters)))),
        (100.0, EMPTY.with_terms({t: np.zeros(len(t.parameters)) for t in (rival, minor)})),
        (0.0, EMPTY),
    ]
    kept = [set(h.terms) for h in without_mere_additions(sets, (main, minor), 1)]
    assert {rival, minor} in kept
    assert {rival, minor} not in [set(h.terms) for h in without_mere_additions(sets, (main,), 1)]


def test_an_equivalent_effect_is_an_alternative_although_another_joint_is_unexplained() -> None:
    """Dry friction at the other joint explains more of the error, but is no alternative to an
    eccentric encoder. A wrong encoder scale is one.
    """
    eccentric, scale, dry = (
        Term("encoder_eccentricity", FIRST), Term("encoder_scale", FIRST),
        Term("coulomb_friction", SECOND),
    )  # fmt: skip
    problem = problem_of(PLANAR, "position", {scale: {"scale_error": 0.04}, dry: {"coulomb": 4.0}})
    found = compared(problem, with_values(problem, {eccentric: {"sine": 0.04, "zeroed": 1.0}}))
    named = [found.best.hypothesis.terms, *(s.model.hypothesis.terms for s in found.sets)]
    assert (scale,) in named
