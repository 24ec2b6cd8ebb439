"""Notes where a residual or a finding may come from the integration error of the time step."""

from __future__ import annotations

from collections.abc import Mapping

from pytest_twin.diagnosis.integrator_settings import INTEGRATOR
from pytest_twin.diagnosis.prepare import discretization_rms
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.estimation.hypothesis import Hypothesis


def integration_errors(
    problem: Problem, errors: Mapping[str, JointError], times: float
) -> dict[str, float]:
    """Joint -> RMS integration error in rad or m, where it is large compared with the residual.

    Args:
        problem: the problem, corrected at the hypothesis.
        errors: errors of each tested joint.
        times: smallest ratio of integration error to residual.
    """
    return {
        joint: float(rms)
        for joint, rms in zip(problem.joints, discretization_rms(problem), strict=True)
        if joint in errors
        and errors[joint].after > INTEGRATOR.note_floors * errors[joint].floor
        and rms > times * errors[joint].after
    }


def notes_on_coarse_step(
    problem: Problem, hypothesis: Hypothesis, errors: Mapping[str, JointError]
) -> list[str]:
    """A note for each joint whose integration error is large compared with residual or findings.

    Predictions are corrected by the integration error to first order only. With a resonant
    transmission or a sudden force, a part of it remains and biases the findings.

    Args:
        errors: errors of each tested joint.
    """
    if not hypothesis.terms:
        return []
    problem = problem.at(hypothesis)
    own = dict(zip(problem.joints, discretization_rms(problem).tolist(), strict=True))
    large = integration_errors(problem, errors, INTEGRATOR.note_ratio)
    found_at = {problem.joints[t.joint] for t in hypothesis.terms if t.joint >= 0}
    step = 1e3 * problem.simulator.timestep
    lines = []
    for joint, error in errors.items():
        if joint in large:
            words = (
                f"{own[joint] / error.after:.0f} times the residual; residual and values may come "
                "from it"
            )
        elif joint in found_at and own[joint] > INTEGRATOR.cause_share * error.before:
            words = (
                f"compared with {error.before:.2g} {error.unit} of the model's error; the findings "
                "at this joint may come from it"
            )
        else:
            continue
        lines.append(
            f"joint {joint!r}: the integration error of the time step ({step:g} ms) is "
            f"{own[joint]:.2g} {error.unit}, {words}. Reduce the model's timestep and repeat the "
            "diagnosis"
        )
    return lines
