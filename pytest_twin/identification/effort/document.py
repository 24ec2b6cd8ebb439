"""Content of ``identification.json``: parameters, uncertainty, and undetermined parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.estimation.covariance import correlated_pairs
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.document import nominal_document, parameter_entry, verdict_of
from pytest_twin.identification.effort.encoders import SCALE, undetermined_entries
from pytest_twin.identification.effort.estimate import SQUARES
from pytest_twin.identification.effort.groups import stage_of
from pytest_twin.identification.effort.identify_effort import EffortResult, mean_relative
from pytest_twin.identification.effort.impossible_drives import impossible_drives
from pytest_twin.identification.effort.stage_comparison import EffortError, parameter_name
from pytest_twin.identification.motions import undetermined_by_effort
from pytest_twin.identification.stages import Stage, in_order
from pytest_twin.metrics.joint_covariance import with_deviations

_UNEXPLAINED = 0.95
"""Relative error of an effort from which nothing of it is predicted."""
_FAR_FROM_LEAST_SQUARES = 1.0
"""Excess over the error of plain least squares, relative to that error, above which the prediction
of a joint is not accepted."""
_SMALL_ERROR = 0.03
"""Relative error of plain least squares below which it counts as so large."""
_INERTIA_OF_MODELS = 0.3
"""Half width of the 95 % interval of a model's inertia, relative: CAD models are right to 30 %."""
_OF_PAYLOADS = "least squares of known payloads"


def effort_document(
    result: EffortResult, stages: Sequence[Stage], written: Mapping[str, EffortError]
) -> dict[str, Any]:
    """Return the content of ``identification.json`` for an identification from measured effort.

    Args:
        stages: stages of the result and further ones.
        written: joint -> error of the written model.
    """
    base, fitted, estimate = result.base, result.fitted, result.estimate
    kept = fitted.kept
    names = [parameter_name(base, int(i)) for i in kept]
    values, half = fitted.solution.values, fitted.solution.half_width
    rejected = {stage.name for stage in stages if stage.state == "rejected"}
    parameters: dict[str, Any] = {}
    prior = base.values(result.regressor.prior)
    # The constant of such a current is measured against the model's inertia.
    of_model = np.array([base.columns[base.independent[i]].kind == EffortScale.id for i in kept])
    half = np.hypot(half, np.where(of_model, _INERTIA_OF_MODELS * np.abs(values), 0.0))
    for k, i in enumerate(kept):
        alone = np.count_nonzero(base.combination[i]) == 1
        column = base.columns[base.independent[i]]
        drive = alone and stage_of(column, weighs=False) in ("friction", "drive")
        parameters[names[k]] = parameter_entry(
            values[k], half[k], base.units[i],
            prior=None if drive and not prior[i] else float(prior[i]),
            stage=result.stage_of[i], used=result.stage_of[i] not in rejected,
            estimator=f"{estimate.estimator}, against the inertia of the model"
            if of_model[k]
            else estimate.estimator,
            bootstrap_ci95=estimate.bootstrap.interval[k].tolist(),
        )  # fmt: skip
        if estimate.estimator != SQUARES:
            parameters[names[k]]["least_squares"] = float(estimate.squares.values[k])
    widths = half / Z95
    # The bias from parameters that are fixed at zero is independent of the noise.
    covariance = with_deviations(fitted.solution.covariance, widths)
    tested = bool(result.held_out)
    offsets = [column.kind == EffortBias.id for column in base.columns]
    of_robot = any(not base.combination[i][offsets].any() for i in kept)
    errors = {
        joint: {
            "effort_relative": error.relative,
            "effort_rms": error.rms,
            "effort_unit": _effort_unit(result, joint),
            **({} if error.moving is None else {"effort_relative_moving": error.moving}),
            "effort_relative_nominal": result.nominal[joint].relative,
            "effort_relative_least_squares": result.least_squares[joint].relative,
            **_rejection(error, result.least_squares[joint]),
        }
        for joint, error in written.items()
    }
    better = mean_relative(written) < mean_relative(result.nominal)
    predicted = not any("rejected" in error for error in errors.values())
    ordered = in_order(stages)
    fatal = any(one.is_fatal for one in result.suspected)
    for joint, scale in result.scales.items():
        parameters[f"{joint}.{EffortScale.id}"] = parameter_entry(
            scale.value, scale.half_width, "1", prior=1.0, stage="drive",
            used=scale.is_significant and "drive" not in rejected, estimator=_OF_PAYLOADS,
        )  # fmt: skip
    for joint, gain in result.gains.items():
        parameters[f"{joint}.{EffortScale.id}"] = parameter_entry(
            gain.value, gain.half_width, f"A/({_effort_unit(result, joint)})", prior=None,
            stage="drive", used=True, estimator=_OF_PAYLOADS,
        )  # fmt: skip
    for reading in result.encoders.readings:
        slide = result.regressor.slides[result.regressor.joints.index(reading.joint)]
        bias = "m" if slide else "rad"
        parameters[f"{reading.joint}.{reading.kind}"] = parameter_entry(
            reading.value, reading.half_width, "1" if reading.kind == SCALE else bias,
            prior=0.0, stage="encoder", estimator=SQUARES,
            used=any(
                (one.joint, one.kind) == (reading.joint, reading.kind)
                for one in result.encoders.corrected
            ),
        )  # fmt: skip
    if result.delay is not None:
        late = result.delay
        parameters[late.name] = parameter_entry(
            late.value, late.half_width, "s", prior=0.0, stage="delay", used=True,
            estimator=SQUARES,
        )  # fmt: skip
    return {
        **nominal_document("measured effort"),
        "verdict": verdict_of(
            ordered,
            better and not fatal,
            tested and of_robot and predicted,
            result.physical.is_consistent,
        ),
        "stages": [stage.to_json() for stage in ordered],
        "parameters": parameters,
        "estimator": estimate.to_json(),
        "bootstrap": {
            "blocks": estimate.bootstrap.blocks,
            "block": "recording" if estimate.bootstrap.recordings else "part of a recording",
            "wider": [names[k] for k in np.flatnonzero(estimate.bootstrap.wider)],
        },
        "covariance": {"names": names, "matrix": covariance.tolist()},
        "correlated": correlated_pairs(names, covariance),
        "base_parameters": [_base_json(result, i, values, widths) for i in range(len(base))],
        "held_out": errors,
        "tested_on": "held-out recordings" if tested else "fitted recordings",
        "physical": {
            "consistent": result.physical.is_consistent,
            "violations": [one.what for one in impossible_drives(base, fitted)],
            "cost": result.physical.cost,
            "note": "the base parameters are measured; their distribution among the links follows "
            "from the nominal model as prior",
        },
        "suspected": [one.to_json() for one in result.suspected],
        "without_effort": list(result.without_effort),
        "unobservable": [
            *_unobservable(result),
            *undetermined_entries(result.encoders.undetermined),
        ],
        "filter": {
            "cutoff": result.filter.cutoff,
            "parallel": result.filter.parallel,
            "rate": result.filter.rate,
            "unit": "Hz",
            "words": result.filter.words,
        },
        "drive_gains": {joint: gain.value for joint, gain in result.gains.items()},
        "noise": {
            joint: float(value)
            for joint, value in zip(result.regressor.joints, fitted.solution.noise, strict=True)
            if np.isfinite(value)
        },
        "condition": fitted.solution.condition,
        "notes": list(result.notes),
    }


def _base_json(result: EffortResult, i: int, values: np.ndarray, std: np.ndarray) -> dict[str, Any]:
    base = result.base
    at = np.flatnonzero(result.fitted.kept == i)
    found: dict[str, Any] = {
        "expression": base.expressions[i],
        "words": base.words[i],
        "unit": base.units[i],
        "prior": float(base.values(result.regressor.prior)[i]),
        "stage": result.stage_of[i],
    }
    if not len(at):
        why = "not moved" if result.unobservable[i] else "not significantly different from zero"
        return {**found, "value": 0.0, "relative_std": None, "essential": False, "why": why}
    value, deviation = float(values[at[0]]), float(std[at[0]])
    return {
        **found,
        "value": value,
        "relative_std": deviation / abs(value) if value else None,
        "std": deviation,
        "essential": True,
    }


def _effort_unit(result: EffortResult, joint: str) -> str:
    units = {c.unit for c in result.regressor.columns
             if c.joint == joint and c.kind == EffortBias.id}  # fmt: skip
    return units.pop()


def _rejection(error: EffortError, least_squares: EffortError) -> dict[str, str]:
    """Return why the prediction of a joint's effort is not accepted, as ``rejected``."""
    moving = error.relative if error.moving is None else error.moving
    if min(error.relative, moving) >= _UNEXPLAINED:
        return {"rejected": f"{100 * error.relative:.0f} % of its effort is not predicted"}
    excess = error.relative - least_squares.relative
    if excess <= _FAR_FROM_LEAST_SQUARES * max(least_squares.relative, _SMALL_ERROR):
        return {}
    why = (
        f"its error of {100 * error.relative:.1f} % is far above the "
        f"{100 * least_squares.relative:.1f} % of base parameters by least squares: the bodies of "
        "the model cannot have these parameters, or a stage is rejected"
    )
    return {"rejected": why}


def _unobservable(result: EffortResult) -> list[dict[str, str]]:
    """Return undetermined parameters, with the motion that would determine them."""
    stages_by_column = dict(zip(result.base.independent.tolist(), result.stage_of, strict=True))
    open_ = result.base.independent[result.unobservable | result.unsure]
    found = []
    for row, i in enumerate(result.structural.independent):
        column = result.structural.columns[i]
        # What this motion shows only in a sum, another motion would show.
        if i in open_ or i not in result.base.independent:
            stage = stages_by_column.get(int(i)) or stage_of(column, column.is_inertial)
            found.append(
                undetermined_by_effort(
                    result.structural.expressions[row], stage, column.joint, column.kind
                )
            )
    return found
