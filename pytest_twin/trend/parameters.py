"""Parameters of every session by linear least squares on measured effort.

The effort of a joint is linear in the parameters of its drive, and in the share of the model's
rigid-body effort (its scale: torque constant, load). Errors of the model's inertia are the same in
all sessions: they are estimated once from all of them, with a Gaussian prior (ridge), and taken out
(nuisance parameters). What differs between sessions remains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from pytest_twin.arrays import FloatArray
from pytest_twin.effects import catalogue
from pytest_twin.effects.sensing import EffortScale
from pytest_twin.estimation.score import effective_samples
from pytest_twin.identification.effort.effort_scale import payload_parameters
from pytest_twin.identification.effort.filtering import Filter
from pytest_twin.identification.effort.laws_along import band_of
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization import Realization

_PRIOR = 0.2
"""Standard deviation of the effort of one inertial error before any recording, relative to the RMS
effort of the joint."""
_FEWEST_ROWS = 20
"""Fewest rows of a joint in a session for an estimate."""
_OVERSAMPLED = 3.0
"""Ratio of the rate of the regressors to that of the rows: positions are filtered below it."""
_RIDGE = 1e-10
"""Share of the diagonal that keeps parameters without influence solvable."""
_SEEN = 1e-6
"""Effort of a unit column, relative to the RMS effort, below which the motion does not show it."""


@dataclass(frozen=True)
class Followed:
    """One parameter of one joint that is followed over sessions.

    Attributes:
        joint: its joint.
        kind: id of the effect.
        unit: unit of its value.
        words: what it is.
    """

    joint: str
    kind: str
    unit: str
    words: str

    @property
    def name(self) -> str:
        """``JOINT.KIND``."""
        return f"{self.joint}.{self.kind}"


@dataclass(frozen=True)
class Estimates:
    """Parameters of every session.

    Attributes:
        followed: (p,) the parameters.
        value, std: (sessions, p) estimate and standard deviation of the estimate; NaN where the
            motion of the session does not show it.
        drift: (sessions, p) value in the second half of a session minus that in its first half.
        held_out: (sessions, joints) effort error with the parameters of the other sessions,
            relative to the RMS effort.
        unexplained: (sessions, joints) the same with the session's own parameters.
        joints: (joints,) names.
    """

    followed: tuple[Followed, ...]
    value: FloatArray
    std: FloatArray
    drift: FloatArray
    held_out: FloatArray
    unexplained: FloatArray
    joints: tuple[str, ...]


@dataclass(frozen=True)
class _Rows:
    """Rows of one joint in one session.

    Attributes:
        rigid: (n, q) effort per inertial parameter.
        drive: (n, k) effort per followed parameter.
        effort: (n,) measured effort without that of a declared payload.
        half: (n,) whether each row is in the second half of the session.
    """

    rigid: FloatArray
    drive: FloatArray
    effort: FloatArray
    half: FloatArray


def estimate(
    realization: Realization, sessions: Sequence[Sequence[MeasuredRecording]]
) -> Estimates:
    """Estimate the parameters of every session.

    Args:
        sessions: recordings of each session, all with the same joints.
    """
    every = [one for session in sessions for one in session]
    joints = every[0].joints
    unscaled = [j for k, j in enumerate(joints) if any(one.unscaled[k] for one in every)]
    regressor = Regressor(realization, joints, (), unscaled)
    chosen = band_of(every)
    rows = [_rows_of(realization, regressor, session, chosen) for session in sessions]
    count = len(joints)
    size = np.array([_rms(np.concatenate([r[j].effort for r in rows])) for j in range(count)])
    shared = _shared_error(rows, size)
    followed = [_followed(regressor, joint, joint in unscaled) for joint in joints]
    width = len(followed[0])
    shape = (len(sessions), count, width)
    value, std, drift = (np.full(shape, np.nan) for _ in range(3))
    held_out, unexplained = (np.full(shape[:2], np.nan) for _ in range(2))
    for j in range(count):
        for s, session in enumerate(rows):
            own = session[j]
            if len(own.effort) < _FEWEST_ROWS:
                continue
            target = own.effort - own.rigid @ shared
            value[s, j], std[s, j], residual = _fit(own.drive, target, size[j])
            unexplained[s, j] = _rms(residual) / _rms(own.effort)
            halves = [own.half == part for part in (0.0, 1.0)]
            if all(int(half.sum()) >= _FEWEST_ROWS for half in halves):
                first, second = (_fit(own.drive[h], target[h], size[j])[0] for h in halves)
                drift[s, j] = second - first
        for s, session in enumerate(rows):
            others = np.delete(value[:, j], s, axis=0)
            known = np.isfinite(others).all(axis=1)
            if not known.any() or len(session[j].effort) < _FEWEST_ROWS:
                continue
            mean = others[known].mean(axis=0)
            own = session[j]
            error = own.effort - own.rigid @ shared - own.drive @ mean
            held_out[s, j] = _rms(error) / _rms(own.effort)
    flat = (len(sessions), count * width)
    return Estimates(
        tuple(one for of_joint in followed for one in of_joint),
        value.reshape(flat), std.reshape(flat), drift.reshape(flat), held_out, unexplained, joints,
    )  # fmt: skip


def _followed(regressor: Regressor, joint: str, is_current: bool) -> list[Followed]:
    """The parameters of a joint, in the order of :func:`_rows_of`."""
    columns = [c for c in regressor.columns if c.joint == joint and not c.is_inertial]
    drive = [c for c in columns if c.kind != EffortScale.id]
    scale = next((c.unit for c in columns if c.kind == EffortScale.id), "1")
    words = (
        "recorded current per unit of the model's effort"
        if is_current
        else ("recorded effort per unit of the model's effort")
    )
    return [
        *(Followed(joint, c.kind, c.unit, catalogue()[c.kind].parameters[0].meaning)
          for c in drive),
        Followed(joint, EffortScale.id, scale, words),
    ]  # fmt: skip


def _rows_of(
    realization: Realization,
    regressor: Regressor,
    session: Sequence[MeasuredRecording],
    chosen: Filter,
) -> list[_Rows]:
    """Rows of every joint; those at rest and at the limit of the drive are left out."""
    inertial = np.array([column.is_inertial for column in regressor.columns])
    sampled = sample(session, [regressor] * len(session), chosen, oversampled=_OVERSAMPLED)
    begin = session[0].stamp * 1e-9 + session[0].start
    clock = [
        one.stamp * 1e-9 + one.start + rows.time - begin
        for one, rows in zip(session, sampled, strict=True)
    ]
    middle = 0.5 * max(float(time[-1]) for time in clock)
    payloads = [payload_parameters(realization, regressor, one) for one in session]
    of_joint = []
    for j, joint in enumerate(regressor.joints):
        at = [k for k, c in enumerate(regressor.columns) if c.joint == joint and not inertial[k]]
        own_scale = [k for k in at if regressor.columns[k].kind == EffortScale.id]
        drive = [k for k in at if k not in own_scale]
        parts = []
        for rows, time, payload in zip(sampled, clock, payloads, strict=True):
            matrix = rows.matrix[:, j]
            effort = rows.effort[:, j]
            rigid = matrix[:, inertial]
            load = rigid @ regressor.prior[inertial]
            if payload is not None:
                load = load + rigid @ payload[inertial]
                effort = effort - rigid @ payload[inertial]
            scale = matrix[:, own_scale[0]] if own_scale else load
            # A scale of 1 is the model itself, so the error of the inertia has its own columns.
            use = np.isfinite(effort) & ~rows.resting[:, j] & ~rows.saturated[:, j]
            both = np.column_stack([matrix[:, drive], scale])
            parts.append((rigid[use], both[use], effort[use], (time > middle)[use]))
        of_joint.append(
            _Rows(*(np.concatenate([part[i] for part in parts]).astype(float) for i in range(4)))
        )
    return of_joint


def _shared_error(rows: Sequence[Sequence[_Rows]], size: FloatArray) -> FloatArray:
    """(q,) error of the model's inertial parameters that all sessions share.

    The followed parameters of every session are eliminated first, so that no change between
    sessions enters it.
    """
    count = rows[0][0].rigid.shape[1]
    matrix, vector, power = np.zeros((count, count)), np.zeros(count), np.zeros(count)
    total = 0
    for session in rows:
        for j, own in enumerate(session):
            if len(own.effort) < _FEWEST_ROWS:
                continue
            basis = np.linalg.qr(own.drive / np.maximum(np.abs(own.drive).max(axis=0), 1e-12))[0]
            rigid = own.rigid / size[j]
            power = np.maximum(power, (rigid**2).mean(axis=0))
            rigid = rigid - basis @ (basis.T @ rigid)
            effort = own.effort / size[j]
            effort = effort - basis @ (basis.T @ effort)
            matrix += rigid.T @ rigid
            vector += rigid.T @ effort
            total += len(effort)
    seen = power > _SEEN**2
    error = np.zeros(count)
    if not seen.any():
        return error
    unit = np.sqrt(power[seen])
    normal = matrix[np.ix_(seen, seen)] / np.outer(unit, unit)
    right = vector[seen] / unit
    # Residuals of a tenth of the effort are the model's error; the ridge counts in their variance.
    ridge = (0.1 / _PRIOR) ** 2 * np.eye(int(seen.sum()))
    error[seen] = scipy.linalg.solve(normal + ridge, right, assume_a="pos") / unit
    return error


def _fit(
    drive: FloatArray, target: FloatArray, size: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(k,) parameters, their standard deviations, and the (n,) residual."""
    effect = np.sqrt((drive**2).mean(axis=0))
    seen = effect > _SEEN * size
    value, std = np.full(drive.shape[1], np.nan), np.full(drive.shape[1], np.nan)
    if not seen.any():
        return value, std, target
    unit = drive[:, seen] / effect[seen]
    normal = unit.T @ unit
    normal += _RIDGE * np.trace(normal) * np.eye(len(normal))
    inverse = np.linalg.inv(normal)
    found = inverse @ (unit.T @ target)
    residual = target - unit @ found
    independent = float(effective_samples(residual[:, None], [len(residual)])[0])
    variance = float((residual**2).mean()) * len(residual) / max(independent - len(found), 1.0)
    value[seen] = found / effect[seen]
    std[seen] = np.sqrt(variance * np.diag(inverse)) / effect[seen]
    return value, std, residual


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 1.0
