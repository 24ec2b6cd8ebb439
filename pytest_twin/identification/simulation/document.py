"""``identification.json`` of an identification from commands and positions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.passive_joints import impossible
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects.base import Parameter
from pytest_twin.estimation.covariance import correlated_pairs
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.document import nominal_document, verdict_of
from pytest_twin.identification.motions import undetermined_by_command
from pytest_twin.identification.simulation.command_mistakes import command_mistakes
from pytest_twin.identification.simulation.identify_by_simulation import SimulationResult
from pytest_twin.identification.simulation.stage_tests import place_of


def simulation_document(result: SimulationResult) -> dict[str, Any]:
    """The content of ``identification.json``, without realization, trials and inputs."""
    problem, hypothesis = result.prepared.problem, result.hypothesis
    parameters, covariance = parameters_with_covariance(result)
    names = list(parameters)
    against = impossible(problem, hypothesis)
    errors = result.errors
    better = np.mean([e.after for e in errors.values()]) < np.mean(
        [e.before for e in errors.values()]
    )
    tested = result.is_tested
    suspected = command_mistakes(result.trials.fit)
    fatal = any(one.is_fatal for one in suspected)
    return {
        **nominal_document("commands and positions"),
        "verdict": verdict_of(result.stages, bool(better) and not fatal, tested, not against),
        "stages": [stage.to_json() for stage in result.stages],
        "parameters": parameters,
        "covariance": {"names": names, "matrix": covariance.tolist()},
        "correlated": correlated_pairs(names, covariance),
        "held_out": {
            joint: {
                "position_rms": error.after,
                "position_unit": error.unit,
                "position_rms_nominal": error.before,
                "noise_floor": error.floor,
            }
            for joint, error in errors.items()
        },
        "tested_on": "held-out recordings" if tested else "fitted recordings",
        "physical": {
            "consistent": not against,
            "violations": [
                f"{place_of(problem, term)}.{term.effect}: {why}" for term, why in against.items()
            ],
        },
        "suspected": [one.to_json() for one in suspected],
        **({"priors": [use.to_json() for use in result.priors]} if result.priors else {}),
        "unobservable": [
            undetermined_by_command(stage, place_of(problem, term), term.effect)
            for term, stage in result.undetermined.items()
        ],
        "notes": list(dict.fromkeys(result.notes)),
    }


def parameters_with_covariance(result: SimulationResult) -> tuple[dict[str, Any], FloatArray]:
    """Return the estimated parameters by name, and their (n, n) covariance, SI units.

    A parameter is not determined if its interval contains every value that its law allows, such as
    the Stribeck velocity of a joint whose friction at rest is as in motion. Its interval is then
    the range of the law, and its variance is 0.
    """
    problem, hypothesis = result.prepared.problem, result.hypothesis
    kept: list[int] = []
    determined: list[bool] = []
    scale: list[float] = []
    parameters: dict[str, Any] = {}
    at = 0
    for term in hypothesis.terms:
        is_estimated = term.is_estimated(hypothesis.theta[hypothesis.slice_of(term)])
        several = int(is_estimated.sum()) > 1
        for k, p in enumerate(term.parameters):
            if is_estimated[k]:
                unit = problem.scales.value(p, term.joint)
                # The name says that a reciprocal was estimated: inverse_limit in 1/(N*m).
                is_named = several or p.reciprocal_of is not None
                name = f"{place_of(problem, term)}.{term.effect}" + (
                    f".{p.name}" if is_named else ""
                )
                theta, half = float(hypothesis.theta[at]), float(result.spread.half_width[at])
                low, high = theta - half, theta + half
                has_end = bool(np.isfinite(half)) and (low > p.lower or high < p.upper)
                if not has_end:
                    low, high = p.lower, p.upper
                parameters[name] = {
                    "value": theta * unit,
                    "unit": _unit(problem, term, p),
                    "ci95": [low * unit, high * unit],
                    "prior": None if p.neutral is None else p.neutral * unit,
                    "stage": result.stage_of[term],
                    "used": True,
                }
                kept.append(at)
                determined.append(has_end)
                scale.append(unit)
            at += 1
    return parameters, _covariance(
        result, np.array(kept, dtype=np.intp), np.array(determined, dtype=bool), np.array(scale)
    )


def _unit(problem: Problem, term: Term, parameter: Parameter) -> str:
    joint = max(term.joint, 0)
    kind = "slide" if problem.simulator.layout.slides[joint] else "hinge"
    return parameter.fitted_unit(kind, str(problem.simulator.layout.servo[joint]))


def _covariance(
    result: SimulationResult,
    kept: NDArray[np.intp],
    determined: NDArray[np.bool_],
    scale: FloatArray,
) -> FloatArray:
    """(n, n) in SI units, as wide as the intervals; 0 for parameters that are not determined.

    The recordings determine combinations of parameters. A parameter that is not determined keeps
    its value, so the covariance of the others is the one at this value (conditional covariance).
    Otherwise they would vary as if it followed them.
    """
    joint = result.spread.conservative_covariance[np.ix_(kept, kept)]
    (free,) = np.nonzero(determined)
    (fixed,) = np.nonzero(~determined & np.isfinite(np.diag(joint)))
    across = joint[np.ix_(free, fixed)]
    found = np.zeros_like(joint)
    found[np.ix_(free, free)] = joint[np.ix_(free, free)] - (
        across @ np.linalg.pinv(joint[np.ix_(fixed, fixed)], hermitian=True) @ across.T
    )
    return np.asarray(np.nan_to_num(found * np.outer(scale, scale)))
