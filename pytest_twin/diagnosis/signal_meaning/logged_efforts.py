"""Origin of the logged efforts of each joint, by the control law and a fitted drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pytest_twin.diagnosis.signal_meaning.effort import (
    JointLog,
    LawFit,
    build_joint_log,
    effort_fact,
    equals_command,
    fit_control_law,
    pool_recordings,
)
from pytest_twin.diagnosis.signal_meaning.effort_settings import EFFORTS
from pytest_twin.diagnosis.signal_meaning.fact import Fact
from pytest_twin.diagnosis.signal_meaning.interpolation_fit import InterpolationFit
from pytest_twin.effects.actuation import ActuatorLag, DeadZone
from pytest_twin.recording_options import COMMAND_BETWEEN, CommandBetween
from pytest_twin.trial import Trial

_COMMAND_ITSELF = Fact(
    "demanded",
    0.9,
    "data",
    "the logged efforts equal the commanded ones to within their noise, so they do not show "
    "what reaches the joint",
)


def logged_efforts(trials: Sequence[Trial], fitted: InterpolationFit) -> dict[str, Fact]:
    """Joint -> origin of its logged effort.

    Args:
        trials: recordings with one command period.
        fitted: the fit of their motion, without efforts.
    """
    found = {}
    for column, joint in enumerate(fitted.joints):
        drive = _drive(fitted, column)
        # Interpolation of the commands -> the laws of each recording.
        demands: dict[CommandBetween, list[LawFit]] = {}
        drives: dict[CommandBetween, list[LawFit]] = {}
        scales, periods = [], []
        largest_first = sorted(
            (t for t in trials if _has_efforts(t, joint)),
            key=lambda t: -_effort_deviation(t, joint),
        )
        if largest_first and all(
            _repeats_command(t, joint) for t in largest_first[: EFFORTS.most_recordings]
        ):
            found[joint] = _COMMAND_ITSELF
            continue
        for trial in largest_first[: EFFORTS.most_recordings]:
            for between in _possible_interpolations(trial):
                log = _build_log(trial, joint, between)
                if log is not None:
                    demands.setdefault(between, []).append(fit_control_law(log))
                    if any(drive):
                        drives.setdefault(between, []).append(fit_control_law(log, *drive))
            scales.append(_effort_deviation(trial, joint))
            periods.append(float(np.median(np.diff(trial.time))))
        if demands:
            found[joint] = effort_fact(
                float(np.median(scales)),
                [pool_recordings(each) for each in demands.values()],
                [pool_recordings(each) for each in drives.values()],
                float(np.median(periods)),
            )
    return found


def _has_efforts(trial: Trial, joint: str) -> bool:
    return trial.effort is not None and joint in trial.joints and joint in trial.command_joints


def _repeats_command(trial: Trial, joint: str) -> bool:
    """Whether the logged efforts of an effort drive are its commands."""
    if trial.mode_of(joint) != "effort":
        return False
    logs = (_build_log(trial, joint, between) for between in _possible_interpolations(trial))
    return any(log is not None and equals_command(log) for log in logs)


def _build_log(trial: Trial, joint: str, between: CommandBetween) -> JointLog | None:
    """Log of a joint with one interpolation of the commands; None if it has gaps or is short."""
    column = trial.joints.index(joint)
    keep = np.concatenate([[True], np.diff(trial.time) > 0.0])
    columns = [trial.position, trial.velocity, trial.effort]
    position, velocity, effort = (None if c is None else c[keep, column] for c in columns)
    assert position is not None
    assert effort is not None
    if not np.isfinite([position, effort]).all():
        return None
    if velocity is not None and not np.isfinite(velocity).all():
        velocity = None
    mode = trial.mode_of(joint)
    assert mode is not None
    setpoint = replace(trial, command_between=between).setpoint
    at = trial.command_joints.index(joint)
    return build_joint_log(trial.time[keep], position, velocity, effort, setpoint, at, mode=mode)


def _drive(fitted: InterpolationFit, column: int) -> tuple[float, float]:
    """Lag in s and dead zone in rad or m of the fitted drive; both 0 if the fit is poor."""
    fit, space = fitted.fit, fitted.space
    left = float(np.sqrt(np.mean(fit.residual[:, column] ** 2)))
    if left > EFFORTS.explained_motion * space.noise[column]:
        return 0.0, 0.0
    lag, dead_zone = (space.value(fit.theta, e, column) for e in (ActuatorLag.id, DeadZone.id))
    return lag, dead_zone


def _possible_interpolations(trial: Trial) -> tuple[CommandBetween, ...]:
    """Possible interpolations of the commands: the declared one, or all."""
    return COMMAND_BETWEEN if trial.between_source == "assumed" else (trial.command_between,)


def _effort_deviation(trial: Trial, joint: str) -> float:
    assert trial.effort is not None
    return float(np.nanstd(trial.effort[:, trial.joints.index(joint)]))
