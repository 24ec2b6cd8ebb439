"""Drives of a model whose inertia and friction are known from measured effort.

Dead zone, limits and supply of a drive are no part of the inverse dynamics. They are fitted to the
motion in the closed loop, with the effects and the stages of an identification from commands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.passive_joints import impossible
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.write import RecordingSettings, load_written, write_realization
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.effects.base import JOINT_FIELDS
from pytest_twin.estimation.covariance import correlated_pairs
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.identify_effort import EffortResult
from pytest_twin.identification.effort.servo_gains import ServoGains
from pytest_twin.identification.measured_recordings import MeasuredRecordings
from pytest_twin.identification.regressor.columns import drive_effects
from pytest_twin.identification.simulation.document import parameters_with_covariance
from pytest_twin.identification.simulation.identify_by_simulation import (
    SimulationResult,
    identify_simulation,
)
from pytest_twin.identification.simulation.stage_effects import StagePlan
from pytest_twin.identification.simulation.stage_tests import with_derivatives
from pytest_twin.identification.stages import Stage
from pytest_twin.identification.write import Patches
from pytest_twin.realization import Realization
from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.signals import Signals
from pytest_twin.trial.joint_side import effort_factor

_FOLLOWS = 0.01
"""Systematic difference from the law of a servo, relative to the effort's deviation, up to which an
effort follows it. It is 0 to 0.1 % for a servo, and 1.6 % or more with a dead zone of 2 % of the
largest effort."""
_DIGITS = 1e-5
"""Relative accuracy of numbers in an MJCF file."""


@dataclass(frozen=True)
class DriveEffects:
    """Effects of drives that were fitted in the closed loop.

    Attributes:
        stage, together: the stages ``drive`` and ``closed_loop``.
        parameters: their parameters for the record.
        covariance: (n, n) covariance of these, in their order.
        fit: attributes of the model that contain an effect, as the table ``fit:`` of a twin.
        outside: effects that no attribute of a model contains, such as ``dead_zone of elbow``.
    """

    stage: Stage
    together: Stage
    parameters: dict[str, dict[str, Any]]
    covariance: FloatArray
    fit: Patches
    outside: tuple[str, ...]


@dataclass(frozen=True)
class DriveRecordings:
    """Recordings to which drives are fitted.

    Attributes:
        fit, held_out: files by role.
        topics, options: settings for reading them.
        has_torques: whether their efforts are torques at the joints, at the stamps of the motion.
        friction: name of a friction parameter from measured effort -> its row in ``covariance``.
        covariance: covariance of the parameters from measured effort, SI units.
        known: gains of the servos whose effort follows the law of a servo, which is not fitted.
    """

    fit: Sequence[Path]
    held_out: Sequence[Path]
    topics: Mapping[str, str]
    options: RecordingOptions
    has_torques: bool
    friction: Mapping[str, int]
    covariance: FloatArray
    known: tuple[ServoGains, ...]


def drive_recordings(
    measured: MeasuredRecordings,
    topics: Mapping[str, str],
    options: RecordingOptions,
    signals: Signals,
    result: EffortResult,
    gains: Sequence[ServoGains],
) -> DriveRecordings | None:
    """Return the recordings for :func:`fit_drives`.

    None where every joint has a servo whose effort follows its law, or where the drive stage is
    rejected.
    """
    joints = result.regressor.joints
    limited = {
        joint
        for one in measured.fit
        for joint, limit in zip(one.joints, one.limit, strict=True)
        if np.isfinite(limit)
    }
    known = tuple(one for one in gains if one.misfit < _FOLLOWS and one.joint not in limited)
    if len(known) == len(joints):
        return None
    if any(one.name == "drive" and one.state == "rejected" for one in result.stages):
        return None
    plain = all(effort_factor(joint, signals) is not None for joint in joints)
    friction = _friction_of_effort()
    scaled = result.gains or any(scale.is_significant for scale in result.scales.values())
    return DriveRecordings(
        list(dict.fromkeys(one.path for one in measured.fit)),
        list(dict.fromkeys(one.path for one in measured.held_out)),
        topics,
        options,
        plain and not scaled and result.delay is None and not result.without_effort,
        {
            column.name: row
            for row, i in enumerate(result.fitted.kept)
            if (column := result.base.columns[result.base.independent[i]]).kind in friction
        },
        result.fitted.solution.covariance,
        known,
    )


def fit_drives(
    fitted: Realization, recordings: DriveRecordings, folder: Path
) -> DriveEffects | None:
    """Fit the effects of drives and write the model that has them; None if there are none.

    Args:
        fitted: the model with inertia and friction of the measured effort, and with known servos.
        recordings: recordings with commands.
        folder: new and empty; gets the model.

    Raises:
        TwinError: the recordings have no commands that can be simulated.
    """
    trials = read_trials(
        recordings.fit, recordings.held_out, recordings.topics, fitted.structure, recordings.options
    )
    if not recordings.has_torques:
        trials = _without_efforts(trials)
    inherited = read_patched_model(fitted)
    with suppress_mujoco_warnings():
        found = identify_simulation(
            fitted, trials,
            inherited=inherited,
            plan=StagePlan.after_effort(frozenset(one.joint for one in recordings.known)),
        )  # fmt: skip
        problem = found.prepared.problem
        if (
            not found.is_complete
            or not found.hypothesis.terms
            or impossible(problem, found.hypothesis)
        ):
            return None
        patched = write_realization(
            folder, fitted, problem, found.hypothesis, inherited,
            RecordingSettings(
                found.prepared.cold_fractions, found.prepared.substeps, found.signals.found_between
            ),
        )  # fmt: skip
    found = replace(found, spread=_widen_by_friction(found, recordings))
    parameters, covariance = parameters_with_covariance(found)
    drive, together = found.stages
    return DriveEffects(
        drive,
        together,
        parameters,
        covariance,
        changed_attributes(fitted.model, load_written(folder).model),
        tuple(
            one.effect if one.joint is None else f"{one.effect} of {one.joint}"
            for one in patched.outside_mjcf
        ),
    )


def with_drive_effects(stages: Sequence[Stage], drives: DriveEffects) -> tuple[Stage, ...]:
    """Return the stages of the inverse dynamics, with these effects in the stage ``drive``."""
    return tuple(
        _merge_stages(one, drives.stage)
        if one.name == "drive" and drives.stage.state in ("accepted", "reopened")
        else one
        for one in stages
    )


def _merge_stages(by_effort: Stage, by_motion: Stage) -> Stage:
    if by_effort.state == "not_observable":
        return by_motion
    added = ", ".join(by_motion.parameters)
    return replace(
        by_effort,
        why=f"{by_effort.why}; in the closed loop {added}: {by_motion.why}",
        parameters=(*by_effort.parameters, *by_motion.parameters),
    )


def add_covariance(document: dict[str, Any], drives: DriveEffects) -> None:
    """Add the covariance of the effects to that of the inverse dynamics, in place.

    Both are independent: one is from efforts, the other from the motion with the former given.
    """
    before = document["covariance"]
    names = [*before["names"], *drives.parameters]
    count = len(before["names"])
    matrix = np.zeros((len(names), len(names)))
    matrix[:count, :count] = np.reshape(before["matrix"], (count, count))
    matrix[count:, count:] = drives.covariance
    document["covariance"] = {"names": names, "matrix": matrix.tolist()}
    document["correlated"] += correlated_pairs(list(drives.parameters), drives.covariance)


def changed_attributes(before: mujoco.MjModel, after: mujoco.MjModel) -> Patches:
    """Return the attributes of joints and actuators that differ, as the table ``fit:`` of a twin.

    Args:
        before, after: two models with the same joints and actuators.
    """
    found: Patches = {"joint": {}, "actuator": {}}
    for joint in range(after.njnt):
        dof = after.jnt_dofadr[joint]
        for attribute in JOINT_FIELDS:
            own, was = (float(getattr(m, f"dof_{attribute}")[dof]) for m in (after, before))
            if not np.isclose(own, was, rtol=_DIGITS):
                found["joint"].setdefault(after.joint(joint).name, {})[attribute] = own
    for actuator in range(after.nactuator):
        for attribute in ("gainprm", "biasprm", "forcerange"):
            values, were = (getattr(m, f"actuator_{attribute}")[actuator] for m in (after, before))
            if not np.allclose(values, were, rtol=_DIGITS):
                name = after.actuator(actuator).name
                found["actuator"].setdefault(name, {})[attribute] = values.tolist()
    return {family: own for family, own in found.items() if own}


def _widen_by_friction(
    found: SimulationResult, recordings: DriveRecordings
) -> ParameterUncertainty:
    """Return the uncertainty of the effects with that of the friction that was given to their fit.

    An error of the friction changes the effects by the ratio of the sensitivities (least squares).
    """
    problem, spread = found.prepared.problem, found.spread
    free = {
        Term(effect, joint): recordings.friction[name]
        for joint, place in enumerate(problem.joints)
        for effect in _friction_of_effort()
        if (name := f"{place}.{effect}") in recordings.friction
        and not any(
            term.joint == joint and effect in (term.effect, *term.law.generalizes)
            for term in found.hypothesis.terms
        )
    }
    if not free:
        return spread
    neutral = {term: np.array([p.absent_value for p in term.parameters]) for term in free}
    whole = with_derivatives(problem, found.hypothesis.with_terms(neutral))
    weight = 1.0 / np.maximum(np.mean(whole.residual**2, axis=0), problem.signal_floor**2)
    own = whole.hypothesis.parameters_without(*free)
    own &= whole.hypothesis.is_estimated
    others = ~whole.hypothesis.parameters_without(*free)
    slopes, pulls = whole.jacobian[..., own], whole.jacobian[..., others]
    curvature = np.einsum("tsp,s,tsq->pq", slopes, weight, slopes)
    across = np.einsum("tsp,s,tsq->pq", slopes, weight, pulls)
    terms = [term for term in whole.hypothesis.terms if term in free]
    scale = np.array([problem.scales.value(t.parameters[0], t.joint) for t in terms])
    rows = [free[term] for term in terms]
    given = recordings.covariance[np.ix_(rows, rows)] / np.outer(scale, scale)
    change = np.linalg.pinv(curvature) @ across
    added = np.zeros_like(spread.conservative_covariance)
    which = np.flatnonzero(found.hypothesis.is_estimated)
    added[np.ix_(which, which)] = change @ given @ change.T
    return replace(
        spread,
        conservative_covariance=spread.conservative_covariance + added,
        half_width=np.hypot(spread.half_width, Z95 * np.sqrt(np.diag(added))),
    )


def _friction_of_effort() -> list[str]:
    """Return the friction that measured effort and motion both show.

    Errors of its values from effort are in the values of the drives.
    """
    return [effect.id for effect in drive_effects() if effect.family == "friction"]


def _without_efforts(trials: TrialSet) -> TrialSet:
    fit, held_out = (
        tuple(replace(trial, effort=None) for trial in each)
        for each in (trials.fit, trials.held_out)
    )
    return replace(trials, fit=fit, held_out=held_out)
