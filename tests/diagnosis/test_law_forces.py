"""Forces of effects along a trajectory, as changes from those of the present hypothesis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from test_first_order import ELBOW, ROBOT, SHOULDER, FloatArray, problem_of

from pytest_twin.diagnosis.first_order import rigid_terms as rigid_terms_module
from pytest_twin.diagnosis.first_order.law_forces import ActiveEffects, LawForces
from pytest_twin.diagnosis.first_order.measured_trajectory import measured_trajectory
from pytest_twin.diagnosis.first_order.rigid_terms import InverseDynamics, RigidTerms, rigid_terms
from pytest_twin.diagnosis.first_order.sensitivities import Linearization
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.effects.base import REFERENCES
from pytest_twin.estimation.hypothesis import EMPTY, Term, effect_values

Variant = Mapping[Term, Sequence[float]]
"""Terms and their parameters, in multiples of references."""

DRAG: Variant = {Term("viscous_friction", SHOULDER): [0.3]}
DELAYED: Variant = {Term("sensor_delay", ROBOT): [0.02], Term("command_delay", ELBOW): [0.02]}
LAG: Variant = {Term("actuator_lag", ELBOW): [0.03, 0.0]}
ELASTIC: Variant = {Term("joint_elasticity", SHOULDER): [0.1, 0.01]}
COUPLED: Variant = {
    Term("joint_coupling", ELBOW): [0.1, 0.0],
    Term("actuator_lag", SHOULDER): [0.02, 0.0],
}


@pytest.fixture(scope="module")
def problem() -> Problem:
    return problem_of("position", DRAG_HIDDEN)


DRAG_HIDDEN = {Term("viscous_friction", ELBOW): {"coefficient": 0.2}}


def test_every_reference_has_a_scale(problem: Problem) -> None:
    assert problem.scales.of.keys() == REFERENCES.keys()


def values(problem: Problem, variants: Sequence[Variant]) -> ActiveEffects:
    hypotheses = []
    for variant in variants:
        h = EMPTY
        for term, theta in variant.items():
            h = h.with_term(term, np.array(theta))
        hypotheses.append(h)
    found = effect_values(hypotheses, len(problem.joints), problem.scales)
    return [(catalogue()[e], v) for e, v in found.items()]


def law_forces_of(problem: Problem) -> LawForces:
    motion = measured_trajectory(problem, EMPTY, problem.fit)
    return LawForces(problem.simulator, motion, rigid_terms(problem.simulator, motion, [])[0])


def changed(
    problem: Problem, laws: LawForces, variants: Sequence[Variant], own: Variant
) -> tuple[FloatArray, FloatArray]:
    mine = values(problem, [own]) if own else []
    base = laws.forces(mine, 1)
    return laws.changes(values(problem, variants), len(variants), mine, base)


@pytest.mark.parametrize(
    "variant", [DRAG, DELAYED, LAG, ELASTIC, COUPLED], ids=lambda v: next(iter(v)).effect
)
def test_a_change_of_forces_equals_the_difference_of_two_full_evaluations(
    problem: Problem, variant: Variant
) -> None:
    laws = law_forces_of(problem)
    # Evaluated between other variants, which must not influence it.
    variants = [DRAG, variant, {}]
    total, drive = changed(problem, laws, variants, {})
    alone, base = laws.forces(values(problem, [variant]), 1), laws.forces([], 1)
    size = np.abs(base.drive).max()
    assert np.abs(total[1]).max() > 1e-3 * size
    assert total[1] == pytest.approx(alone.total[0] - base.total[0], abs=1e-9 * size)
    assert drive[1] == pytest.approx(alone.drive[0] - base.drive[0], abs=1e-9 * size)
    assert not total[2].any()


def test_forces_at_a_joint_with_unchanged_effects_do_not_change(problem: Problem) -> None:
    laws = law_forces_of(problem)
    total, _ = changed(problem, laws, [{**LAG, **DRAG}, {**LAG}], LAG)
    assert total[0, :, :, SHOULDER].any()
    assert not total[0, :, :, ELBOW].any()
    assert not total[1].any()


def test_removing_an_effect_changes_the_forces_by_its_negative(problem: Problem) -> None:
    laws = law_forces_of(problem)
    without, _ = changed(problem, laws, [{}, DRAG], LAG)
    with_it, _ = changed(problem, laws, [LAG], {})
    # An effect with memory is sampled differently, so both are equal to second order only.
    size = np.abs(with_it).max()
    assert np.linalg.norm(without[0] + with_it[0]) < 0.1 * np.linalg.norm(with_it[0])
    assert without[1, :, :, ELBOW] == pytest.approx(without[0, :, :, ELBOW], abs=1e-9 * size)


LOAD: Variant = {Term("payload", ROBOT): [0.3, 1.0, 0.0, 0.0, 0.0]}
OFFSET_LOAD: Variant = {Term("payload", ROBOT): [0.2, 0.5, 0.7, -0.4, 2.0]}
HEAVY: Variant = {Term("inertial_parameters", SHOULDER): [0.4, 0.0, 0.0, 0.0, 0.0, 0.0]}
MORE_INERTIA: Variant = {Term("inertial_parameters", SHOULDER): [0.0, 0.0, 0.5, 0.0, 0.0, 2.0]}
MOVED: Variant = {Term("inertial_parameters", SHOULDER): [0.0, 0.1, 0.2, 0.3, -0.2, 3.0]}
TILTED: Variant = {Term("base_tilt", ROBOT): [0.1, -0.2]}
ROTOR: Variant = {Term("armature", SHOULDER): [0.1]}


def test_efforts_of_changed_bodies_equal_the_sum_of_precomputed_parts(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    variants: list[Variant] = [
        {}, LOAD, {**LOAD, **HEAVY}, OFFSET_LOAD, {**OFFSET_LOAD, **MORE_INERTIA},
        {**TILTED, **LOAD}, {**MOVED, **LOAD},
    ]  # fmt: skip
    motion, simulator = measured_trajectory(problem, EMPTY, problem.fit), problem.simulator
    whole = [rigid_terms(simulator, motion, values(problem, [v]))[0].effort for v in variants]
    efforts = InverseDynamics(simulator, motion)
    computed: list[int] = []

    def counted(*args: Any) -> list[RigidTerms]:
        computed.append(args[3])
        return rigid_terms(*args)

    monkeypatch.setattr(rigid_terms_module, "rigid_terms", counted)
    size = np.abs(whole[0]).max()
    for found, true in zip(efforts.of(values(problem, variants[:5]), 5), whole, strict=False):
        assert found == pytest.approx(true, abs=1e-9 * size)
    # Parts: mass and inertia of one link, and a mass at ten points. They are computed once.
    assert computed == [12]
    efforts.of(values(problem, variants[:5]), 5)
    assert computed == [12]
    # Another center of mass needs five further parts.
    (moved,) = efforts.of(values(problem, [variants[6]]), 1)
    assert moved == pytest.approx(whole[6], abs=1e-9 * size)
    assert np.abs(moved - whole[1]).max() > 1e-2 * size
    assert computed == [12, 5]
    # Another direction of gravity is computed without these parts.
    (tilted,) = efforts.of(values(problem, [variants[5]]), 1)
    assert tilted == pytest.approx(whole[5], abs=1e-9 * size)
    assert np.abs(tilted - whole[1]).max() > 1e-2 * size


@pytest.mark.parametrize("other", [ROTOR, ELASTIC], ids=["armature", "elasticity"])
def test_motor_effects_are_counted_once_in_combination_with_a_payload(
    problem: Problem, other: Variant
) -> None:
    linear = Linearization(problem, EMPTY, problem.fit)

    def read(variant: Variant) -> FloatArray:
        h = EMPTY
        for term, theta in variant.items():
            h = h.with_term(term, np.array(theta))
        return linear.differences([h])[0]

    small: Variant = {Term("payload", ROBOT): [0.01, 1.0, 0.0, 0.0, 0.0]}
    alone = read(other)
    most = float(np.abs(alone).max())
    assert 0.0 < np.abs(read(small)).max() < 0.2 * most
    assert read({**other, **small}) - read(small) == pytest.approx(alone, abs=1e-3 * most)


def test_delayed_commands_act_with_their_mean_over_each_time_step(problem: Problem) -> None:
    """Commands are held between stamps, and each joint has its own delay."""
    simulator = problem.simulator
    segment = simulator.segments[0]
    delays = [[0.0, 0.0], [0.0137, 0.0], [0.0137, 0.2], [0.0, 0.0]]
    rows, steps, fine = np.zeros(4, np.int64), 40, 400
    delayed = values(
        problem,
        [
            {Term("command_delay", SHOULDER): [a], Term("command_delay", ELBOW): [b]}
            for a, b in delays
        ],
    )
    found = simulator.commands(rows, delayed, steps)
    assert found.shape == (4, steps, 2)
    step = simulator.timestep
    at = segment.start + step / fine * (np.arange(steps * fine) + 0.5)
    for row, mine in zip(found, delays, strict=True):
        for j, delay in enumerate(mine):
            held = np.searchsorted(segment.command_time, at - delay, side="right") - 1
            true = segment.command[np.maximum(held, 0), j].reshape(steps, fine).mean(axis=1)
            assert row[:, j] == pytest.approx(true, abs=2e-3)
    # A later call for one joint and fewer steps does not depend on the earlier one.
    elbow = np.array([[ELBOW]])
    one_joint = simulator.commands(rows[:1], [], 7, elbow)
    assert np.array_equal(one_joint[0, :, 0], found[0, :7, ELBOW])
