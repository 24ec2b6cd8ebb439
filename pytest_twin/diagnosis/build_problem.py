"""The estimation problem of some recordings, and the residuals of hypotheses in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.known_errors import with_known_errors
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import AppliedEffect
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.diagnosis.verdict import UNSEEN
from pytest_twin.effects.contact_geoms import ContactGeoms
from pytest_twin.errors import SimulationError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales
from pytest_twin.realization import Realization
from pytest_twin.realization.inputs import joint_inputs
from pytest_twin.trial import Trial


def build_problem(
    setup: ModelSetup,
    trials: TrialSet,
    notes: list[str],
    window: float | None = None,
    contact: ContactGeoms | None = None,
    scales: Scales | None = None,
) -> tuple[PreparedProblem, TrialSet]:
    """Build the problem; recordings on which the nominal model diverges are left out.

    Args:
        setup: the model and its simulation settings.
        notes: receives a line for each recording that is left out.
        window, contact, scales: as :func:`~pytest_twin.diagnosis.prepare.prepare` has them.

    Raises:
        SimulationError: it diverges on all of them.
    """
    while True:
        everything = (*trials.fit, *trials.held_out)
        prepared = setup.prepare(trials.fit, trials.held_out, window, contact, scales)
        problem = prepared.problem
        predicted = problem.predict([EMPTY], problem.all_segments)[0]
        diverged = {
            prepared.segment_trial[s]
            for s, p in enumerate(predicted)
            if not np.isfinite(p.position).all()
        }
        if not diverged:
            idle = _joints_without_setpoint(setup.realization, problem)
            notes += _notes_on_assumptions(prepared, everything, setup.outside_mjcf, idle)
            # Under this noise floor no residual counts, and no fit depends on the joint.
            unseen = np.isin(problem.joints, [*trials.unseen, *idle])
            problem = with_known_errors(
                problem,
                [everything[i] for i in prepared.segment_trial],
                setup,
                trials.earlier,
                window,
            )
            floor = np.where(unseen, UNSEEN, problem.floor)
            return replace(prepared, problem=replace(problem, floor=floor)), trials
        for i in sorted(diverged):
            notes.append(f"left out: {everything[i].path}: the simulation of the model diverges")
        fit = tuple(t for i, t in enumerate(everything[: len(trials.fit)]) if i not in diverged)
        aside = tuple(
            t for i, t in enumerate(trials.held_out, start=len(trials.fit)) if i not in diverged
        )
        if not fit:
            raise SimulationError(
                "the simulation of the model diverges under the recorded commands",
                path=everything[min(diverged)].path,
                expected="a model that can be simulated through at least one recording; check its "
                "gains, inertias and timestep",
            )
        trials = replace(trials, fit=fit, held_out=aside)


def _notes_on_assumptions(
    prepared: PreparedProblem,
    trials: Sequence[Trial],
    outside_mjcf: Sequence[AppliedEffect],
    idle: Sequence[str],
) -> list[str]:
    """Assumptions that no recording confirms, a line each."""
    problem = prepared.problem
    notes = [
        f"{e.effect} of joint {e.joint!r} is not applied: no recording contains this joint"
        for e in outside_mjcf
        if not e.is_in_mjcf and e.joint not in (None, *problem.joints)
    ]
    owners = prepared.segment_trial
    for i, trial in enumerate(trials):
        first = problem.simulator.segments[owners.index(i)]
        if first.start > 0.0 and first.command_time[0] > 0.0:
            notes.append(
                f"{trial.path.name}: its first {first.start:.3g} s are not used, because the "
                "command before the first recorded one is unknown"
            )
        if first.velocity is None and not first.starts_in_motion and first.initial_velocity.any():
            notes.append(
                f"{trial.path.name}: the robot moves at the start and no velocity is recorded; the "
                "initial velocity is estimated from the positions"
            )
    notes += [
        f"joint {joint!r}: no recording contains commands of its servo; it is assumed to hold its "
        "initial position, and its error is not evaluated"
        for joint in idle
    ]
    return notes + notes_on_low_weights(problem)


def notes_on_low_weights(problem: Problem) -> list[str]:
    """A line for each joint at which some windows have less than half the weight of others."""
    if not problem.position_weights:
        return []
    weights = np.array(list(problem.position_weights.values()))
    few = (weights < 0.5 * weights.max(axis=0)).sum(axis=0)
    return [
        f"joint {joint!r}: {few[j]} of {len(weights)} windows have less than half the weight, in "
        "the errors too: dry friction sticks or reverses there, and its presliding is unknown"
        for j, joint in enumerate(problem.joints)
        if few[j]
    ]


def _joints_without_setpoint(realization: Realization, problem: Problem) -> list[str]:
    """Joints with a position servo whose setpoint is not recorded."""
    servo = problem.simulator.layout.servo
    return [
        joint
        for joint, mode in zip(problem.joints, servo, strict=True)
        if mode == "none"
        and any(i.mode == "position" for i in joint_inputs(realization.model, joint))
    ]


def residuals_everywhere(problem: Problem, hypothesis: Hypothesis) -> FloatArray:
    """(samples, signals) residuals of all segments, corrected for the integration error."""
    return problem.at(hypothesis).residuals([hypothesis], problem.all_segments)[0]
