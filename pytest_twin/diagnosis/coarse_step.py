"""Where what is left, or what was explained, may be the error of the model's own step."""

from __future__ import annotations

from collections.abc import Mapping

from pytest_twin.diagnosis.hypothesis import Hypothesis
from pytest_twin.diagnosis.prepare import discretization
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.verdict import JointError

_STANDS, _OF_IT = 2.0, 3.0
"""Floors that are left, and times as much that the step's own error has to be."""
_OF_ALL = 0.5
"""Share of what was to be explained beyond which the step's own error may have been what was."""


def off_by_the_step(
    problem: Problem, errors: Mapping[str, JointError], times: float
) -> dict[str, float]:
    """Joint -> root mean square of the step's own error, rad or m, where more than the floor is
    left and that error is more than so many times what is.

    Args:
        problem: refined at what explains it.
        errors: of each joint that was tested.
        times: how much more.
    """
    return {
        joint: float(rms)
        for joint, rms in zip(problem.joints, discretization(problem), strict=True)
        if joint in errors
        and errors[joint].after > _STANDS * errors[joint].floor
        and rms > times * errors[joint].after
    }


def coarse_step(
    problem: Problem, hypothesis: Hypothesis, errors: Mapping[str, JointError]
) -> list[str]:
    """A line for each joint where the step's own error is far more than what is left over the
    floor, or about what was to be explained where something was found.

    Every prediction is corrected by that error, measured by refining the step, to first order: of a
    gear that rings or a push that is sudden some stays, and what was found bends to it.

    Args:
        problem: what was explained.
        hypothesis: what explains it.
        errors: of each joint that was tested.
    """
    if not hypothesis.terms:
        return []
    problem.refine_at(hypothesis)
    own = dict(zip(problem.joints, discretization(problem).tolist(), strict=True))
    off = off_by_the_step(problem, errors, _OF_IT)
    found_at = {problem.joints[t.joint] for t in hypothesis.terms if t.joint >= 0}
    step = 1e3 * problem.simulator.timestep
    lines = []
    for joint, error in errors.items():
        if joint in off:
            words = f"{own[joint] / error.after:.0f} times what is left: that, and sizes, may be"
        elif joint in found_at and own[joint] > _OF_ALL * error.before:
            words = (
                f"and {error.before:.2g} {error.unit} were to be explained: what was found at it "
                "may be"
            )
        else:
            continue
        lines.append(
            f"joint {joint!r}: with what was found the simulator's step of {step:g} ms is itself "
            f"{own[joint]:.2g} {error.unit} off, {words} the step's; a smaller timestep of the "
            "model says more"
        )
    return lines
