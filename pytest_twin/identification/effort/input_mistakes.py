"""Detect mistakes of the input from the fit. Corrections are proposed, never applied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.friction import CoulombFriction, ViscousFriction
from pytest_twin.effects.rigid_body import Armature
from pytest_twin.effects.sensing import EffortBias, EffortScale
from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.least_squares import LinearProblem, Solution, solve
from pytest_twin.identification.effort.recording_rows import RecordingRows, sample
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization
from pytest_twin.signals import Signals

_SURE = 6.0
"""Number of standard deviations above which a sign or a factor is significant."""
_FAR = 4.0
"""Ratio between nominal and measured effort that neither a payload nor a missing rotor explains.
Inertia of CAD models is right to 30 %; rotors double the accelerated inertia of a joint at most."""
_LIKE = 0.25
"""Largest logarithmic distance between a ratio and the stated gear ratio."""
_MANY_TURNS = 4.0 * math.pi
"""Span, rad, of a joint without limits above which its positions may be in degrees."""
_GEARED = 3.0
"""Smallest gear ratio whose omission is detected."""
_ONE_SIGN = 0.01
"""Share of an effort's power with the other sign, up to which it may be an amount with noise."""
_TURNS = 0.05
"""Smallest share of samples in which the model's effort has the other sign."""
_SIGN_ROUNDS = 5
"""Number of fits, each with the signs of the one before."""
_BETTER = 0.5
"""Largest ratio of residuals for which other positions or signs explain the effort better."""


@dataclass(frozen=True, slots=True)
class InputMistake:
    """A suspected mistake of the input.

    Attributes:
        what: joint, mistake and the figure that shows it.
        is_fatal: whether the result must be rejected until it is corrected.
    """

    joint: str
    what: str
    mend: str
    is_fatal: bool = True

    def to_json(self) -> dict[str, object]:
        """Content for ``identification.json``."""
        return {"what": self.what, "mend": self.mend, "fatal": self.is_fatal}


def unless_checked(suspected: Sequence[InputMistake], signals: Signals) -> list[InputMistake]:
    """Return the suspicions; where a person checked the signals of a joint, none is fatal."""
    return [
        replace(one, is_fatal=one.is_fatal and not signals.of(one.joint).checked)
        for one in suspected
    ]


def find_mistakes(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    samples: Sequence[RecordingRows],
    regressor: Regressor,
    gears: Sequence[float],
) -> list[InputMistake]:
    """Detect degrees without joint ranges, wrong signs, and wrong factors of efforts.

    Each joint is fitted separately: the nominal rigid-body effort is one column; the others are
    friction and a constant. Negative friction is impossible, and a factor far from 1 is no error of
    a CAD model.

    Args:
        recordings, samples: fitted recordings and their rows.
        gears: (joints,) stated gear ratios, 1 by default.
    """
    found = _rescaling_by_effort(realization, recordings, samples, regressor, gears)
    for k, joint in enumerate(regressor.joints):
        alone = _fit_joint_alone(samples, regressor, k)
        if alone is None:
            continue
        if amount := _unsigned_effort(samples, regressor, k):
            found.append(amount)
            continue
        factor, viscous, dry = alone.values[:3]
        std = np.maximum(alone.std[:3], 1e-300)
        negative = max(-viscous / std[1], -dry / std[2]) > _SURE and min(viscous, dry) < 0
        negative = negative and max(viscous / std[1], dry / std[2]) < _SURE
        unscaled = any(c.joint == joint and c.kind == EffortScale.id for c in regressor.columns)
        if negative:
            found.append(InputMistake(
                joint,
                f"{joint}: the effort helps the motion (viscous {viscous:.3g}, dry {dry:.3g}, both "
                "should resist): its sign is wrong",
                f"signals: joints: {joint}: gear: {-gears[k]:g}, or the sign of its effort alone",
            ))  # fmt: skip
        elif factor < 0 and factor < -_SURE * std[0]:
            found.append(InputMistake(
                joint,
                f"{joint}: friction resists and the rigid bodies' effort has the opposite sign "
                f"(factor {factor:.3g}): position and effort are counted against the model's axis",
                f"calibration: joints: {joint}: {{sign: -1}}, or the axis of the model",
            ))  # fmt: skip
        elif not unscaled and factor > _SURE * std[0] and abs(math.log(factor)) > math.log(_FAR):
            found.append(_factor(joint, float(factor), abs(gears[k])))
    return found


def contradicted_factors(
    samples: Sequence[RecordingRows], regressor: Regressor, gears: Sequence[float]
) -> list[InputMistake]:
    """Joints whose effort no plausible factor of the model's bodies explains.

    The factor that fits best lies beyond 1 / 4 to 4, and with the nearest plausible one the
    residual at least doubles. So it does not rest on standard deviations, which are too small
    where the residual is no noise.

    Args:
        gears: (joints,) stated gear ratios, 1 by default.
    """
    found = []
    for k, joint in enumerate(regressor.joints):
        problem = _alone_problem(samples, regressor, k)
        if problem is None:
            continue
        use = problem.known[:, 0]
        columns, effort = problem.matrix[use, 0], problem.effort[use, 0]
        factor = float(np.linalg.lstsq(columns, effort, rcond=None)[0][0])
        plausible = min(max(factor, 1.0 / _FAR), _FAR)
        best, forced = (
            float(np.linalg.norm(target - own @ np.linalg.lstsq(own, target, rcond=None)[0]))
            for own, target in (
                (columns, effort),
                (columns[:, 1:], effort - plausible * columns[:, 0]),
            )
        )
        if best < _BETTER * forced:
            found.append(_factor(joint, factor, abs(gears[k])))
    return found


@dataclass(frozen=True, slots=True)
class _Rescaling:
    """A factor on the positions of some joints, and the mistake that it would correct."""

    joints: tuple[int, ...]
    factor: float
    what: str
    mend: str


def _rescaling_by_effort(
    realization: Realization,
    recordings: Sequence[MeasuredRecording],
    samples: Sequence[RecordingRows],
    regressor: Regressor,
    gears: Sequence[float],
) -> list[InputMistake]:
    """Detect joints whose effort fits far better along positions times a common factor."""
    spans = np.max([np.ptp(one.position, axis=0) for one in recordings], axis=0)
    best: dict[int, tuple[float, _Rescaling]] = {}
    for trial in _rescalings(realization, regressor, spans, np.abs(gears)):
        scale = np.ones(len(regressor.joints))
        scale[list(trial.joints)] = trial.factor
        turned = [replace(one, position=one.position * scale) for one in recordings]
        rows = sample(turned, [regressor] * len(turned), choose_filter(turned))
        for k in trial.joints:
            before, after = (
                _fit_joint_alone(samples, regressor, k),
                _fit_joint_alone(rows, regressor, k),
            )
            if before is None or after is None:
                continue
            noise = float(after.noise[0])
            limit = best[k][0] if k in best else _BETTER * float(before.noise[0])
            if noise <= limit:
                best[k] = noise, trial
    return [
        InputMistake(
            regressor.joints[k],
            f"{regressor.joints[k]}: positions span {spans[k]:.4g} "
            f"{'m' if regressor.slides[k] else 'rad'}, and along {one.factor:.3g} times as much "
            f"the model explains the effort better: {one.what}",
            f"signals: joints: {regressor.joints[k]}: position: {one.mend}",
        )
        for k, (_, one) in sorted(best.items())
    ]


def _rescalings(
    realization: Realization, regressor: Regressor, spans: FloatArray, gears: FloatArray
) -> list[_Rescaling]:
    """Return factors on the positions that their spans suggest.

    Joints whose positions exceed their limits are left to ``position_mistakes``.
    """
    model = realization.model
    at = [realization.joint_index(joint) for joint in regressor.joints]
    limited = [bool(model.jnt_limited[index]) for index in at]
    ranges = [float(np.ptp(model.jnt_range[i])) if own else _MANY_TURNS
              for i, own in zip(at, limited, strict=True)]  # fmt: skip
    wide = [k for k, own in enumerate(limited) if not own and spans[k] > _MANY_TURNS]
    # A log in degrees has all joints in degrees, and the joints' efforts are coupled.
    turning = tuple(k for k in wide if not regressor.slides[k])
    found = [_Rescaling(turning, math.pi / 180.0, "they seem to be in degrees", "{unit: deg}")]
    geared = [k for k in range(len(at)) if gears[k] > _GEARED]
    found += [
        _Rescaling((k,), 1.0 / gears[k], "they are on the motor's side", "{side: motor}")
        for k in geared
        if k in wide
    ]
    found += [
        _Rescaling((k,), gears[k], "they are not on the motor's side", "{side: output}")
        for k in geared
        if spans[k] * gears[k] <= ranges[k]
    ]
    return [one for one in found if one.joints]


def _factor(joint: str, factor: float, gear: float) -> InputMistake:
    what = f"{joint}: the effort is {factor:.3g} times what the model's bodies need"
    for power, said in ((1, "is not applied to the effort"), (2, "is applied the wrong way round")):
        if (
            gear > 1.0
            and factor > 0.0
            and (abs(abs(math.log(factor)) - power * math.log(gear)) < _LIKE)
        ):
            return InputMistake(
                joint,
                f"{what}: the gear ratio {gear:g} {said}",
                f"signals: joints: {joint}: side of position and effort, and gear",
            )
    return InputMistake(
        joint,
        f"{what}: no payload and no rotor explains that",
        f"signals: joints: {joint}: gear, side or unit of its effort; quantity: current where it "
        "is one; checked: true where they are right",
        is_fatal=False,
    )


def _unsigned_effort(
    samples: Sequence[RecordingRows], regressor: Regressor, joint: int
) -> InputMistake | None:
    """Return a suspicion if an effort of one sign fits far better as an amount."""
    ratio = amount_ratio(samples, regressor, joint)
    if ratio is None or ratio > _BETTER:
        return None
    name = regressor.joints[joint]
    return InputMistake(
        name,
        f"{name}: the effort has one sign and fits {1.0 / ratio:.2g} times better with the sign of "
        "the model's effort: it is an amount, without a sign",
        f"signals: joints: {name}: effort: {{signed: false}}, and record the signed effort",
    )


def amount_ratio(
    samples: Sequence[RecordingRows], regressor: Regressor, joint: int
) -> float | None:
    """Return the residual of an effort as an amount, relative to that as a torque.

    The effort is given the sign of the model's effort, which depends on the fit: both are repeated
    in turn. Infinite if the model's effort has one sign: an effort that only carries weight keeps
    it. None if the effort has both signs, or if the joint does not move.
    """
    problem = _alone_problem(samples, regressor, joint)
    if problem is None:
        return None
    effort = problem.effort[problem.known]
    power = float(np.sum(effort**2))
    if (
        min(np.sum(effort[effort < 0.0] ** 2), np.sum(effort[effort > 0.0] ** 2))
        > _ONE_SIGN * power
    ):
        return None
    bias = 3
    amount = np.abs(problem.effort)
    model = problem.matrix[:, 0, 0]
    for _ in range(_SIGN_ROUNDS):
        sign = np.where(model < 0.0, -1.0, 1.0)
        columns = problem.matrix.copy()
        # A constant of an amount has the amount's sign.
        columns[:, 0, bias] = sign
        turned = replace(problem, matrix=columns, effort=sign[:, None] * amount)
        found = solve(turned, intervals=False)
        columns[:, 0, bias] = 0.0
        model = columns[:, 0] @ found.values
    shown = sign[problem.known[:, 0]]
    if min(float(np.mean(shown < 0.0)), float(np.mean(shown > 0.0))) < _TURNS:
        return math.inf
    before = solve(problem, intervals=False)
    return float(found.noise[0]) / max(float(before.noise[0]), 1e-300)


def _fit_joint_alone(
    samples: Sequence[RecordingRows], regressor: Regressor, joint: int
) -> Solution | None:
    """Fit factor of the rigid bodies, viscous and dry friction and constant effort of one joint."""
    problem = _alone_problem(samples, regressor, joint)
    return None if problem is None else solve(problem)


def _alone_problem(
    samples: Sequence[RecordingRows], regressor: Regressor, joint: int
) -> LinearProblem | None:
    """Columns of one joint: rigid bodies, viscous and dry friction, constant effort, armature."""
    name = regressor.joints[joint]
    at = {c.kind: i for i, c in enumerate(regressor.columns) if c.joint == name}
    rigid = np.array([c.is_inertial or c.kind == EffortScale.id for c in regressor.columns])
    weights: FloatArray = np.where(rigid, regressor.prior, 0.0)
    if EffortScale.id in at:
        weights[at[EffortScale.id]] = 1.0
    columns = np.concatenate([
        np.stack([
            s.matrix[:, joint] @ weights,
            *(s.matrix[:, joint, at[kind]] for kind in
              (ViscousFriction.id, CoulombFriction.id, EffortBias.id, Armature.id)),
        ], axis=1)
        for s in samples
    ])  # fmt: skip
    effort = np.concatenate([s.effort[:, joint] for s in samples])
    resting = np.concatenate([s.resting[:, joint] for s in samples])
    known = np.isfinite(effort) & ~resting
    sizes = np.linalg.norm(columns[known], axis=0)
    if known.sum() < 50 or sizes[:3].min() < 1e-6 * sizes.max():
        return None
    return LinearProblem(
        columns[:, None], np.where(known, effort, 0.0)[:, None], known[:, None], resting[:, None],
        np.array([[False, False, True, False, False]]), tuple(len(s.time) for s in samples),
    )  # fmt: skip
