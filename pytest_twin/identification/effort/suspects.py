"""Detect mistakes of the input from the fit. Corrections are proposed, never applied."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.least_squares import Linear, Solution, solve
from pytest_twin.identification.effort.sampled import Sampled, sample
from pytest_twin.identification.measured import Measured
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import Realization

_SURE = 6.0
"""Number of standard deviations above which a sign or a factor is significant."""
_FAR = 4.0
"""Ratio between nominal and measured effort that neither a payload nor a missing rotor explains.
Inertia of CAD models is right to 30 %; rotors double the accelerated inertia of a joint at most."""
_LIKE = 0.25
"""Largest logarithmic distance between a ratio and the stated gear ratio."""
_OUTSIDE = 3.0
"""Ratio of the span of positions to the joint's range above which they may be in degrees."""
_MANY_TURNS = 4.0 * math.pi
"""Span, rad, of a joint without limits above which its positions may be in degrees."""


@dataclass(frozen=True, slots=True)
class Suspect:
    """A suspected mistake of the input.

    Attributes:
        what: joint, mistake and the figure that shows it.
        mend: how to correct it.
        is_fatal: whether the result must be rejected until it is corrected.
    """

    what: str
    mend: str
    is_fatal: bool = True

    def to_json(self) -> dict[str, object]:
        """Content for ``identification.json``."""
        return {"what": self.what, "mend": self.mend, "fatal": self.is_fatal}


def suspects(
    realization: Realization,
    recordings: Sequence[Measured],
    samples: Sequence[Sampled],
    regressor: Regressor,
    gears: Sequence[float],
) -> list[Suspect]:
    """Detect degrees, wrong signs, and gear ratios that are not applied or applied twice.

    Each joint is fitted separately: the nominal rigid-body effort is one column; the others are
    friction and a constant. Negative friction is impossible, and a factor far from 1 is no error of
    a CAD model.

    Args:
        realization: the nominal model.
        recordings, samples: fitted recordings and their rows.
        regressor: regressor of the robot.
        gears: (joints,) stated gear ratios, 1 by default.
    """
    found = _degrees(realization, recordings)
    if not found:
        found = _degrees_by_effort(realization, recordings, samples, regressor)
    for k, joint in enumerate(regressor.joints):
        alone = _alone(samples, regressor, k)
        if alone is None:
            continue
        factor, viscous, dry = alone.values[:3]
        std = np.maximum(alone.std[:3], 1e-300)
        negative = max(-viscous / std[1], -dry / std[2]) > _SURE and min(viscous, dry) < 0
        negative = negative and max(viscous / std[1], dry / std[2]) < _SURE
        unscaled = any(c.joint == joint and c.kind == "effort_scale" for c in regressor.columns)
        if negative:
            found.append(Suspect(
                f"{joint}: the effort helps the motion (viscous {viscous:.3g}, dry {dry:.3g}, both "
                "should resist): its sign is wrong",
                f"signals: joints: {joint}: gear: {-gears[k]:g}, or the sign of its effort alone",
            ))  # fmt: skip
        elif factor < 0 and factor < -_SURE * std[0]:
            found.append(Suspect(
                f"{joint}: friction resists and the rigid bodies' effort has the opposite sign "
                f"(factor {factor:.3g}): position and effort are counted against the model's axis",
                f"calibration: joints: {joint}: {{sign: -1}}, or the axis of the model",
            ))  # fmt: skip
        elif not unscaled and factor > _SURE * std[0] and abs(math.log(factor)) > math.log(_FAR):
            found.append(_factor(joint, float(factor), abs(gears[k])))
    return found


def _degrees(realization: Realization, recordings: Sequence[Measured]) -> list[Suspect]:
    found = []
    model = realization.model
    for k, joint in enumerate(recordings[0].joints):
        index = realization.joint_index(joint)
        low, high = model.jnt_range[index]
        if not model.jnt_limited[index] or high <= low:
            continue
        span = max(float(np.ptp(one.position[:, k])) for one in recordings)
        if span > _OUTSIDE * (high - low) and math.radians(span) <= 1.1 * (high - low):
            found.append(Suspect(
                f"{joint}: positions span {span:.4g} rad, its range is {high - low:.3g} rad: they "
                "seem to be in degrees",
                f"signals: joints: {joint}: position: {{unit: deg}}",
            ))  # fmt: skip
    return found


def _degrees_by_effort(
    realization: Realization,
    recordings: Sequence[Measured],
    samples: Sequence[Sampled],
    regressor: Regressor,
) -> list[Suspect]:
    """Detect joints without limits whose effort fits far better if positions are degrees."""
    spans = np.max([np.ptp(one.position, axis=0) for one in recordings], axis=0)
    wide = [
        k
        for k, joint in enumerate(regressor.joints)
        if not regressor.slides[k]
        and not realization.model.jnt_limited[realization.joint_index(joint)]
        and spans[k] > _MANY_TURNS
    ]
    if not wide:
        return []
    factor = np.ones(len(regressor.joints))
    factor[wide] = math.pi / 180.0
    turned = [replace(one, position=one.position * factor) for one in recordings]
    rows = sample(turned, [regressor] * len(turned), choose_filter(turned))
    found = []
    for k in wide:
        before, after = _alone(samples, regressor, k), _alone(rows, regressor, k)
        if before is None or after is None or after.noise[0] > 0.5 * before.noise[0]:
            continue
        joint = regressor.joints[k]
        found.append(Suspect(
            f"{joint}: positions span {spans[k]:.4g} rad, and along so many degrees the model "
            "explains the effort better: they seem to be in degrees",
            f"signals: joints: {joint}: position: {{unit: deg}}",
        ))  # fmt: skip
    return found


def _factor(joint: str, factor: float, gear: float) -> Suspect:
    what = f"{joint}: the effort is {factor:.3g} times what the model's bodies need"
    for power, said in ((1, "is not applied to the effort"), (2, "is applied the wrong way round")):
        near = abs(abs(math.log(factor)) - power * math.log(gear)) < _LIKE
        if gear > 1.0 and near:
            return Suspect(
                f"{what}: the gear ratio {gear:g} {said}",
                f"signals: joints: {joint}: side of position and effort, and gear",
            )
    return Suspect(
        f"{what}: no payload and no rotor explains that",
        f"signals: joints: {joint}: gear, side or unit of its effort; quantity: current where it "
        "is one",
    )


def _alone(samples: Sequence[Sampled], regressor: Regressor, joint: int) -> Solution | None:
    """Fit factor of the rigid bodies, viscous and dry friction and constant effort of one joint."""
    name = regressor.joints[joint]
    at = {c.kind: i for i, c in enumerate(regressor.columns) if c.joint == name}
    rigid = np.array([c.is_inertial or c.kind == "effort_scale" for c in regressor.columns])
    weights: FloatArray = np.where(rigid, regressor.prior, 0.0)
    if "effort_scale" in at:
        weights[at["effort_scale"]] = 1.0
    columns = np.concatenate([
        np.stack([
            s.matrix[:, joint] @ weights,
            *(s.matrix[:, joint, at[kind]] for kind in
              ("viscous_friction", "coulomb_friction", "effort_bias", "armature")),
        ], axis=1)
        for s in samples
    ])  # fmt: skip
    effort = np.concatenate([s.effort[:, joint] for s in samples])
    resting = np.concatenate([s.resting[:, joint] for s in samples])
    known = np.isfinite(effort) & ~resting
    sizes = np.linalg.norm(columns[known], axis=0)
    if known.sum() < 50 or sizes[:3].min() < 1e-6 * sizes.max():
        return None
    problem = Linear(
        columns[:, None], np.where(known, effort, 0.0)[:, None], known[:, None], resting[:, None],
        np.array([[False, False, True, False, False]]), tuple(len(s.time) for s in samples),
    )  # fmt: skip
    return solve(problem)
