"""Linearized search: known hidden effects are found without a simulation of any candidate.

The package itself simulates the plants, with one or two effects and the noise of an ordinary
encoder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import (
    BeamSearch,
    CandidateSensitivities,
    NormalEquations,
    ResidualView,
    Structure,
    candidates,
)
from pytest_twin.diagnosis.first_order.bins import bins
from pytest_twin.diagnosis.first_order.law_forces import LawForces, state_force_derivatives
from pytest_twin.diagnosis.first_order.linearized_dynamics import (
    LinearizedDynamics,
    linearize_dynamics,
)
from pytest_twin.diagnosis.first_order.measured_trajectory import (
    MeasuredTrajectory,
    measured_trajectory,
)
from pytest_twin.diagnosis.first_order.rigid_terms import rigid_terms, upsample
from pytest_twin.diagnosis.first_order.sensitivities import (
    Linearization,
    Sensitivity,
    linearize,
    sensitivities_around,
    starting_grid,
)
from pytest_twin.diagnosis.free_initial_state import free_initial_states
from pytest_twin.diagnosis.problem import REFINE, Problem, joint_scales, replay_nominal
from pytest_twin.diagnosis.smoothing import derivatives, smooth_state
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY, Term

Hidden = Mapping[Term, Mapping[str, float]]
"""Effects of the plant that the model lacks, with parameters in SI units."""

NOISE = 3e-4
"""Standard deviation in rad of an encoder with 4096 counts and some jitter."""
SAMPLE, SECONDS, WINDOW, START_WIDTH = 0.01, 5.0, 0.5, 0.12
NEAR = 0.1
ABSENT = 0.05
"""Largest estimate of an absent effect, as a multiple of the reference of its amplitude."""

ARM = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="shoulder" axis="0 1 0" damping=".4" armature=".02"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/><body pos=".3 0 0">
<joint name="elbow" axis="0 1 0" damping=".15" armature=".01"/>
<geom type="capsule" fromto="0 0 0 .25 0 0" size=".02" mass=".5"/></body></body></worldbody>
<actuator><position joint="shoulder" kp="60" kv="2"/><position joint="elbow" kp="25" kv=".7"/>
</actuator></mujoco>
"""
CRANK = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="crank" axis="0 1 0" damping=".05" armature=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body></worldbody>
<actuator><motor joint="crank"/></actuator></mujoco>
"""
ROBOT, SHOULDER, ELBOW, CRANK_JOINT = -1, 0, 1, 0


def link(form: int, **values: float) -> dict[str, float]:
    """Inertial parameters in one form, with the other parameters neutral."""
    none = {p.name: 0.0 for p in Term("inertial_parameters", SHOULDER).parameters}
    return {**none, **values, "form": float(form)}


def rate(**values: float) -> dict[str, float]:
    """A limit of one rate, without a limit of the other."""
    return {"inverse_rate": 0.0, "inverse_effort_rate": 0.0, "of_effort": 0.0, **values}


def carried(
    mass: float, distance: float, sideways: float = 0.0, across: float = 0.0
) -> dict[str, float]:
    """A payload in the form with the fewest parameters."""
    form = 2.0 if across else 1.0 if sideways else 0.0
    return {
        "mass": mass, "distance": distance, "sideways": sideways, "across": across, "form": form
    }  # fmt: skip


# Command mode, hidden effect with its joint, and its parameters.
ALONE: list[tuple[str, Term, dict[str, float]]] = [
    ("position", Term("viscous_friction", ELBOW), {"coefficient": 0.2}),
    ("position", Term("coulomb_friction", SHOULDER), {"coulomb": 0.3}),
    ("position", Term("command_delay", ELBOW), {"delay": 0.02}),
    ("position", Term("actuator_lag", SHOULDER), {"time_constant": 0.02, "of_setpoint": 0.0}),
    ("position", Term("actuator_lag", SHOULDER), {"time_constant": 0.02, "of_setpoint": 1.0}),
    ("position", Term("rate_limit", ELBOW), rate(inverse_rate=1 / 1.5)),
    ("effort", Term("rate_limit", CRANK_JOINT), rate(inverse_rate=1 / 6.0)),
    ("position", Term("dead_zone", ELBOW), {"width": 0.012, "of_effort": 0.0}),
    ("position", Term("dead_zone", ELBOW), {"width": 0.012, "of_effort": 1.0}),
    (
        "position",
        Term("load_dependent_friction", SHOULDER),
        {"coefficient": 0.2, "of_drive": 0.0},
    ),
    (
        "position",
        Term("load_dependent_friction", SHOULDER),
        {"coefficient": 0.2, "of_drive": 1.0},
    ),
    (
        "position",
        Term("encoder_eccentricity", SHOULDER),
        {"sine": 0.02, "cosine": 0.01, "zeroed": 1.0},
    ),
    (
        "position",
        Term("encoder_eccentricity", SHOULDER),
        {"sine": 0.02, "cosine": 0.01, "zeroed": 0.0},
    ),
    ("position", Term("torque_saturation", SHOULDER), {"inverse_limit": 1 / 4.0}),
    ("position", Term("encoder_bias", ELBOW), {"bias": 0.03, "in_loop": 0.0}),
    ("position", Term("payload", ROBOT), carried(0.1, 0.12)),
    ("position", Term("payload", ROBOT), carried(0.1, 0.12, 0.06)),
    ("position", Term("inertial_parameters", SHOULDER), link(0, relative_error=0.15)),
    ("position", Term("inertial_parameters", ELBOW), link(1, mass_error=0.3)),
    ("position", Term("inertial_parameters", ELBOW), link(2, inertia_error=2.0)),
    ("position", Term("inertial_parameters", ELBOW), link(3, radial=0.02, tangential=0.01)),
    (
        "position",
        Term("joint_elasticity", SHOULDER),
        {"compliance": 1 / 150.0, "damping_time": 0.008},
    ),
    ("position", Term("joint_coupling", ELBOW), {"ratio": 0.08, "form": 0.0}),
    ("position", Term("joint_coupling", SHOULDER), {"ratio": 0.3, "form": 1.0}),
    ("position", Term("joint_coupling", ELBOW), {"ratio": 0.08, "form": 2.0}),
    ("position", Term("joint_coupling", SHOULDER), {"ratio": 0.08, "form": 3.0}),
    ("position", Term("joint_coupling", ELBOW), {"ratio": 0.02, "form": 4.0}),
    ("position", Term("joint_coupling", SHOULDER), {"ratio": 0.02, "form": 5.0}),
    (
        "position",
        Term("external_force", SHOULDER),
        {"effort": 1.0, "start": 2.0, "duration": 0.6},
    ),
    ("effort", Term("viscous_friction", CRANK_JOINT), {"coefficient": 0.08}),
    ("effort", Term("coulomb_friction", CRANK_JOINT), {"coulomb": 0.15}),
    ("effort", Term("torque_constant", CRANK_JOINT), {"relative_error": 0.12}),
    ("effort", Term("inertial_parameters", CRANK_JOINT), link(0, relative_error=0.2)),
]
# Laws that contain another as a special case. They also fit the error of its linearization, so they
# may rank before it here. Fits by simulation decide between them.
GENERALIZED_BY: Mapping[str, frozenset[str]] = {
    # To first order, a delay and a lag of the command are the same.
    "command_delay": frozenset({"actuator_lag"}),
    "actuator_lag": frozenset({"command_delay"}),
    # Special cases: damping error of a servo, no warm-up, equal in both directions.
    "viscous_friction": frozenset(
        {"controller_gain", "thermal_friction", "directional_viscous_friction"}
    ),
    # A bias causes a constant effort of the servo, as a preload does.
    "encoder_bias": frozenset({"joint_spring"}),
    # With one joint, a larger torque constant acts like a lighter link.
    "torque_constant": frozenset({"inertial_parameters"}),
    # A last link with other mass, inertia and center represents any payload.
    "payload": frozenset({"inertial_parameters"}),
    # Special cases: no excess, no offset, no waves, no warm-up.
    "coulomb_friction": frozenset(
        {
            "stribeck_friction",
            "asymmetric_friction",
            "position_dependent_friction",
            "thermal_friction",
        }
    ),
}


def wave(time: FloatArray, joints: int, size: float) -> FloatArray:
    """(samples, joints) three sines for each joint, from rest."""
    random = np.random.default_rng(1)
    frequency = random.uniform(0.3, 1.6, (3, joints))
    phase = random.uniform(0.0, 2.0 * np.pi, (3, joints))
    total = np.zeros((len(time), joints))
    for f, p in zip(frequency, phase, strict=True):
        total += np.sin(2.0 * np.pi * time[:, None] * f + p)
    return size * total * np.minimum(time / 0.4, 1.0)[:, None]


def simulated_positions(segment: Segment, joints: tuple[str, ...], hidden: Hidden) -> FloatArray:
    """(samples, joints) positions of a plant with ``hidden`` effects."""
    values: dict[str, dict[str, FloatArray]] = {}
    for term, own in hidden.items():
        values[term.effect] = {
            p.name: np.full((1, len(joints)), own[p.name] if p.neutral is None else p.neutral)
            for p in term.parameters
        }
        for name, value in own.items():
            column = slice(None) if term.joint < 0 else term.joint
            values[term.effect][name][:, column] = value
    simulator = BatchSimulator([segment], joints, threads=1)
    return simulator.simulate(np.array([0]), values)[0].position


def sensitivities(problem: Problem, terms: Sequence[Term]) -> tuple[list[Sensitivity], FloatArray]:
    """Sensitivities of candidates at the nominal model, and its residual, (bins, signals)."""
    linear = linearize(problem, problem.fit, EMPTY)
    (residual,) = problem.residuals([EMPTY], problem.fit)
    return sensitivities_around(linear, problem, terms, problem.fit, EMPTY, residual)


def problem_of(mode: str, hidden: Hidden) -> Problem:
    """An arm with position servos, or a crank under effort commands in short windows."""
    servo = mode == "position"
    joints = ("shoulder", "elbow") if servo else ("crank",)
    model = mujoco.MjModel.from_xml_string(ARM if servo else CRANK)
    time: FloatArray = SAMPLE * np.arange(round(SECONDS / SAMPLE), dtype=np.float64)
    still = np.zeros(len(joints))
    segment = Segment(
        trial=0, model=model, mode=mode, start=0.0, time=time,
        position=np.zeros((len(time), len(joints))), velocity=None, effort=None,
        command_time=time, command=wave(time, len(joints), 0.25 if servo else 1.0),
        initial_position=still, initial_velocity=still,
    )  # fmt: skip
    position = simulated_positions(segment, joints, hidden)
    position = position + NOISE * np.random.default_rng(2).standard_normal(position.shape)
    segments = [replace(segment, position=position)]
    if not servo:
        segments = []
        smooth, speed, _ = derivatives(time, position, START_WIDTH)
        for start in np.arange(0.0, SECONDS - 1e-9, WINDOW):
            inside = (time >= start - 1e-9) & (time <= start + WINDOW + 1e-9)
            q, v = smooth_state(time, position, float(start), START_WIDTH)
            segments.append(
                replace(segment, start=float(start), time=time[inside], position=position[inside],
                        initial_position=q, initial_velocity=v, history=(time, smooth, speed))
            )  # fmt: skip
    simulator = BatchSimulator(segments, joints, threads=1)
    scales = joint_scales(simulator, replay_nominal(simulator))
    noise = np.full(len(joints), NOISE)
    problem = Problem(simulator, np.arange(len(segments)), np.zeros(0, np.int64), noise, scales)
    if not servo:
        problem = replace(
            problem,
            start_noise=noise,
            find_starts=lambda h: free_initial_states(segments, joints, noise, 1, h, scales),
        )
    return problem.at(EMPTY)


def test_external_forces_that_last_beyond_the_recording_have_one_sensitivity() -> None:
    problem = problem_of("position", {})
    term = Term("external_force", ELBOW)
    found, _ = sensitivities(problem, [term])
    changes = [r.change for r in found]
    assert not any(np.array_equal(a, b) for i, a in enumerate(changes) for b in changes[:i])
    # For every start time, one force lasts until the end.
    whole, each = SECONDS / 12.0, {}
    for r in found:
        _, start, lasts = r.start * [problem.scales.value(p, ELBOW) for p in term.parameters]
        each[start] = max(each.get(start, 0.0), start + lasts)
    assert min(each.values()) >= SECONDS - whole
    assert len(each) == len(term.parameters[1].starts)


def test_effects_that_are_evaluated_together_have_the_sensitivities_of_each_alone() -> None:
    problem = problem_of("position", {})
    lag = Term("actuator_lag", ELBOW)
    linear = Linearization(problem, EMPTY.with_term(lag, starting_grid(lag)[0][0]), problem.fit)
    names = ("viscous_friction", "coulomb_friction", "backlash", "rate_limit", "controller_gain")
    groups = [[Term(n, SHOULDER), Term(n, ELBOW)] for n in (*names, "encoder_bias")]
    together = {
        (r.term, r.start.tobytes()): r.change
        for r in linear.sensitivities([t for group in groups for t in group])
    }
    alone = [r for group in groups for r in linear.at_sizes(group, starting_grid(group[0]))]
    assert len(alone) == len(together) > 40
    for r in alone:
        found = together[r.term, r.start.tobytes()]
        np.testing.assert_allclose(found, r.change, rtol=1e-5, atol=1e-6 * np.abs(r.change).max())


def normal_equations(problem: Problem) -> NormalEquations:
    """Normal equations of all candidates of the catalogue, around the nominal model."""
    answers, left = sensitivities(problem, candidates(problem))
    lengths = bins(problem, problem.fit).lengths
    view = ResidualView(left, np.empty((*left.shape, 0)), problem.signal_floor, lengths)
    return NormalEquations(view, CandidateSensitivities(answers))


def assert_near(problem: Problem, term: Term, start: FloatArray, hidden: Hidden) -> None:
    """Amplitudes start near their true values; shape parameters start on their grid."""
    for p, found in zip(term.parameters, start, strict=True):
        if p.neutral is not None:
            truth = hidden[term][p.name] / problem.scales.value(p, term.joint)
            assert found == pytest.approx(truth, rel=NEAR, abs=0.0 if truth else ABSENT), p.name


@pytest.mark.parametrize(
    ("mode", "term", "values"), ALONE, ids=[f"{m}-{t.effect}" for m, t, _ in ALONE]
)
def test_the_hidden_effect_ranks_first_and_starts_near_its_true_value(
    mode: str, term: Term, values: dict[str, float]
) -> None:
    hidden = {term: values}
    problem = problem_of(mode, hidden)
    equations = normal_equations(problem)
    level = np.sqrt(np.mean(equations.view.residual**2, axis=0)) / equations.view.floor
    assert level.max() > 10.0, "the effect must be far above the noise floor"
    children = [equations.structure(chosen) for chosen in equations.children(equations.base)[:12]]
    ahead: list[Term] = []
    for structure in equations.rank(equations.base, children):
        ((found, start),) = structure.starts.items()
        if found == term:
            assert_near(problem, term, start, hidden)
            break
        ahead.append(found)
    else:
        pytest.fail(f"{term} is not among the best candidates: {ahead}")
    assert set(ahead) <= generalizations_of(problem, term)


def generalizations_of(problem: Problem, term: Term) -> set[Term]:
    """Effects that may rank before a term; for an effect of the robot, those of its last joint."""
    joint = len(problem.joints) - 1 if term.joint == ROBOT else term.joint
    return {Term(e, joint) for e in GENERALIZED_BY.get(term.effect, ())}


def test_an_external_force_starts_at_the_closest_times_of_the_grid() -> None:
    term = Term("external_force", SHOULDER)
    mode, _, values = next(a for a in ALONE if a[1] == term)
    problem = problem_of(mode, {term: values})
    equations = normal_equations(problem)
    first = equations.structure(equations.children(equations.base)[0])
    for p, found in zip(term.parameters, first.starts[term], strict=True):
        if p.neutral is None:
            truth = values[p.name] / problem.scales.value(p, term.joint)
            nearest = p.starts[int(np.argmin([abs(s - truth) for s in p.starts]))]
            assert found == nearest, p.name


@pytest.mark.parametrize("harmonic", [1.0, 4.0])
def test_position_dependent_friction_is_found_with_its_wavenumber(harmonic: float) -> None:
    term = Term("position_dependent_friction", SHOULDER)
    hidden = {term: {"mean": 0.5, "sine": 0.2, "cosine": 0.3, "harmonic": harmonic}}
    equations = normal_equations(problem_of("position", hidden))
    children = [equations.structure(chosen) for chosen in equations.children(equations.base)[:12]]
    ((first, start),) = equations.rank(equations.base, children)[0].starts.items()
    assert first == term
    assert start[3] == harmonic


PAIRS: list[tuple[str, dict[Term, dict[str, float]]]] = [
    (
        "position",
        {
            Term("command_delay", ELBOW): {"delay": 0.02},
            Term("payload", ROBOT): carried(0.1, 0.12),
        },
    ),
    (
        "effort",
        {
            Term("torque_constant", CRANK_JOINT): {"relative_error": 0.12},
            Term("viscous_friction", CRANK_JOINT): {"coefficient": 0.08},
        },
    ),
]


@pytest.mark.parametrize(("mode", "hidden"), PAIRS, ids=[m for m, _ in PAIRS])
def test_two_effects_are_found_together(mode: str, hidden: dict[Term, dict[str, float]]) -> None:
    problem = problem_of(mode, hidden)
    equations = normal_equations(problem)

    def is_accepted(before: FloatArray, after: FloatArray) -> bool:
        return bool((after < 0.9 * before).any())

    levels = BeamSearch(width=6, most=2, earns=5.0, is_accepted=is_accepted).levels(equations)
    pairs = [s for level in levels for s in level if len(s.starts) == 2]
    at = next(i for i, s in enumerate(pairs) if set(s.starts) == set(hidden))
    allowed = {*hidden, *(held for t in hidden for held in generalizations_of(problem, t))}
    assert all(set(s.starts) <= allowed for s in pairs[:at])
    for term, start in pairs[at].starts.items():
        assert_near(problem, term, start, hidden)
    ones: list[Structure] = [equations.structure(c) for c in equations.children(equations.base)[:6]]
    best = equations.rank(equations.base, ones)[0]
    assert equations.rank(best, [pairs[at]])[0].evidence > 20.0


# -- linearized equation of motion

MASS, DAMPING, KP, KV, STEP = 2.0, 3.0, 80.0, 4.0, 0.002


def slide(limit: float, push: float) -> tuple[MeasuredTrajectory, LinearizedDynamics]:
    """A slide that follows a ramp without lag; a constant force of ``push`` N acts on its plant."""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast" gravity="0 0 0"/><worldbody>'
        f'<body><inertial pos="0 0 0" mass="{MASS}" diaginertia="1 1 1"/>'
        f'<joint name="j" type="slide" axis="1 0 0" damping="{DAMPING}"/></body></worldbody>'
        f'<actuator><position joint="j" kp="{KP}" kv="{KV}" forcerange="-{limit} {limit}"/>'
        "</actuator></mujoco>"
    )
    time = SAMPLE * np.arange(151, dtype=np.float64)
    sent = STEP * np.arange(751, dtype=np.float64)
    segment = Segment(
        trial=0, model=model, mode="position", start=0.0, time=time,
        position=np.zeros((len(time), 1)), velocity=None, effort=None,
        command_time=sent, command=((DAMPING + KV) / KP + sent)[:, None],
        initial_position=np.zeros(1), initial_velocity=np.ones(1),
    )  # fmt: skip
    force = {"effort": push, "start": -1.0, "duration": 1e3}
    hidden = {Term("external_force", 0): force} if push else {}
    segment = replace(segment, position=simulated_positions(segment, ("j",), hidden))
    simulator = BatchSimulator([segment], ("j",), threads=1)
    scales = joint_scales(simulator, replay_nominal(simulator))
    problem = Problem(simulator, np.array([0]), np.zeros(0, np.int64), np.full(1, 1e-6), scales)
    motion = measured_trajectory(problem, EMPTY, problem.fit)
    rigid = rigid_terms(simulator, motion)[0]
    measured = LawForces(simulator, motion, rigid).forces([], 1)
    predicted = LawForces(simulator, motion.predicted, rigid).forces([], 1)
    slopes = state_force_derivatives(simulator, motion, rigid, [])
    return motion, linearize_dynamics(simulator, motion, [], measured, predicted, slopes)


def closed_form(time: FloatArray, force: float) -> tuple[FloatArray, FloatArray]:
    """Responses to a constant force from rest, and to an initial velocity of 1 m/s."""
    natural = np.sqrt(KP / MASS)
    ratio = (DAMPING + KV) / (2.0 * np.sqrt(KP * MASS))
    damped = natural * np.sqrt(1.0 - ratio**2)
    fading = np.exp(-ratio * natural * time)
    sine, cosine = np.sin(damped * time), np.cos(damped * time)
    pushed = force / KP * (1.0 - fading * (cosine + ratio * natural / damped * sine))
    return pushed, fading * sine / damped


def test_small_deviations_of_a_linear_joint_equal_the_closed_form() -> None:
    motion, equation = slide(limit=1e3, push=0.0)
    time = motion.interval * np.arange(motion.position.shape[1])
    force = np.zeros((1, len(time), 1, 2))
    force[..., 0] = 5.0
    initial = np.zeros((1, 2, 2))
    initial[0, 1, 1] = 1.0
    found = equation.trajectory(force, initial)[0]
    for column, expected in enumerate(closed_form(time, 5.0)):
        assert np.abs(found[:, 0, column] - expected).max() < 3e-4 * np.abs(expected).max()
        velocity = np.gradient(expected, motion.interval)
        inner = slice(1, -1)
        assert np.abs(found[inner, 1, column] - velocity[inner]).max() < 2e-2


def test_secant_slopes_predict_large_deviations_with_a_saturated_drive() -> None:
    push = 30.0
    motion, equation = slide(limit=12.0, push=push)
    time = motion.interval * np.arange(motion.position.shape[1])
    off = (motion.position - motion.predicted_position)[0, :, 0]
    force, still = np.full((1, len(time), 1, 1), push), np.zeros((1, 2, 1))
    found = equation.trajectory(force, still)[0, :, 0, 0]
    assert off[-1] > 3.0
    assert np.abs(found - off).max() < 0.01 * np.abs(off).max()
    # The tangent at the prediction has the full servo stiffness and gives a wrong deviation.
    tangent = closed_form(time, push)[0]
    assert np.abs(tangent - off).max() > 0.5 * np.abs(off).max()


def test_effects_of_the_present_fit_change_the_linearized_dynamics() -> None:
    """Quadratic drag damps deviations; the nominal model does not contain it."""
    drag, other = Term("quadratic_drag", CRANK_JOINT), Term("viscous_friction", CRANK_JOINT)
    problem = problem_of("effort", {drag: {"coefficient": 1.5}})

    def size(term: Term, value: float) -> FloatArray:
        return np.array([value / problem.scales.value(term.parameters[0], 0)])

    named = EMPTY.with_term(drag, size(drag, 1.5))
    more = named.with_term(other, size(other, 0.06))
    problem = problem.at(named)
    linear = linearize(problem, problem.fit, named)
    assert linear is not None
    first_order = linear.differences([more])[0]
    without, with_it = problem.residuals([named, more], problem.fit)
    simulated = bins(problem, problem.fit).mean(without - with_it)
    off = np.sqrt(np.mean((first_order - simulated) ** 2))
    # Without the slope of the drag, the result would be five times too large.
    assert off < 0.3 * np.sqrt(np.mean(simulated**2))


def test_slopes_of_forces_equal_their_derivatives() -> None:
    drag, cogging = Term("quadratic_drag", CRANK_JOINT), Term("cogging", CRANK_JOINT)
    problem = problem_of("effort", {drag: {"coefficient": 0.3}})
    motion = measured_trajectory(problem, EMPTY, problem.fit)
    rigid = rigid_terms(problem.simulator, motion, [])[0]
    shape: dict[Term, dict[str, float]] = {
        drag: {"coefficient": 0.3},
        cogging: {"sine": 0.2, "cosine": 0.1, "harmonic": 5.0},
    }
    effects = [
        (t.law, {n: np.full((1, 1), v) for n, v in values.items()}) for t, values in shape.items()
    ]
    stiffness, damping = state_force_derivatives(problem.simulator, motion, rigid, effects)
    position, velocity = motion.midway
    wave = 5.0 * (0.2 * np.cos(5.0 * position) - 0.1 * np.sin(5.0 * position))
    # At rest, dry friction compensates for changes of the force.
    moving = np.abs(velocity) > 20.0 * motion.slip_velocity
    assert moving.mean() > 0.5
    assert stiffness[moving] == pytest.approx(-wave[moving], abs=1e-4)
    assert damping[moving] == pytest.approx(0.6 * np.abs(velocity[moving]), abs=1e-3)


@given(
    at=st.lists(st.integers(1, 60), min_size=0, max_size=6, unique=True),
    seed=st.integers(0, 2**16),
)
@settings(max_examples=40, deadline=None)
def test_upsampled_values_are_linear_between_their_points(at: list[int], seed: int) -> None:
    points = np.array([0, *sorted(at)])
    values = np.random.default_rng(seed).standard_normal((2, len(points), 3, 2))
    samples = int(points[-1]) + 1
    found = upsample(values, points, samples)
    assert found.shape == (2, samples, 3, 2)
    for s, j, k in np.ndindex(2, 3, 2):
        expected = np.interp(np.arange(samples), points, values[s, :, j, k])
        assert np.abs(found[s, :, j, k] - expected).max() < 1e-12


def test_the_hidden_effects_cover_the_families_of_the_catalogue() -> None:
    families = {catalogue()[t.effect].family for _, t, _ in ALONE}
    assert families >= {
        "timing", "sensing", "actuation", "friction", "transmission", "rigid_body", "environment",
    }  # fmt: skip


@pytest.mark.parametrize("mode", ["position", "effort"])
@pytest.mark.parametrize(
    ("term", "rough"),
    [(Term("viscous_friction", SHOULDER), False), (Term("contact_friction", ROBOT), True)],
    ids=["smooth", "rough"],
)
def test_trajectories_with_readings_equal_the_predictions(
    mode: str, term: Term, rough: bool
) -> None:
    problem = problem_of(mode, {})
    refined = BatchSimulator(problem.simulator.segments, problem.joints, threads=1, refine=REFINE)
    problem = problem.with_simulator(problem.simulator, refined)
    hypothesis = EMPTY.with_term(term, np.array([p.starts[0] for p in term.parameters]))
    assert hypothesis.is_discontinuous is rough
    problem = problem.at(hypothesis)
    assert problem.discretization_error
    _, _, followed = problem.trajectories_with_readings(hypothesis, problem.fit)
    for once, again in zip(followed, problem.predict([hypothesis], problem.fit)[0], strict=True):
        assert (once.position == again.position).all()
        assert (once.velocity == again.velocity).all()
        assert (once.effort == again.effort).all()
