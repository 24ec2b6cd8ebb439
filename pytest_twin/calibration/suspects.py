"""Mistakes in the input that would explain large errors: units, directions, signs.

Each is tried on a copy of the observations by an algebraic solver. None is ever applied: a person
corrects the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration import closed_form
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.problem import Problem, predicted_poses
from pytest_twin.calibration.solve import Fit
from pytest_twin.calibration.starts import seen_poses, starts
from pytest_twin.calibration.terms import PointTerm, PoseTerm

FAR_BETTER = 1.0 / 3.0
"""An alternative is named where it leaves less than this part of both the median position error
and the median angle error. The errors of a real arm without its joint zeros fall by 2 at most when
the sign of a joint is chosen wrongly for the right one."""

DOUBTFUL_M = 0.003
"""Root mean square of a fit beyond which mistakes are looked for where the plan accepts any error:
half of the smallest error that a wrong unit, direction or sign makes on an arm of 0.3 m."""

DOUBTFUL_RAD = 0.01

LEAST_ROWS = 6
"""Observations below which nothing is suspected: a few poses fit any mistake."""

FAR_AWAY_M = 20.0
"""A flange, or a target, further away than this from what it is measured from is given in mm."""

_TURNS = 4 * np.pi
"""A joint reading beyond two turns, rad: it may be in degrees."""

_SCALES = {0.001: "mm", 1000.0: "mm", 0.01: "cm", 100.0: "cm", 0.0254: "inches"}


@dataclass(frozen=True)
class Suspect:
    """A mistake that would explain the errors.

    Attributes:
        what: what seems to be wrong, in words.
        mend: what to do.
        translation, rotation: median errors with the mistake undone, m and rad (NaN for points).
        factor: that positions of the target must be multiplied by, where that is the correction.
    """

    what: str
    mend: str
    translation: float
    rotation: float
    factor: float | None = None

    def to_json(self) -> dict[str, object]:
        """As ``calibration.json`` has it."""
        made: dict[str, object] = {
            "what": self.what,
            "mend": self.mend,
            "translation_median": self.translation,
        }
        if np.isfinite(self.rotation):
            made["rotation_median"] = self.rotation
        if self.factor is not None:
            made["factor"] = self.factor
        return made


def doubtful(fitted: Mapping[str, float], problem: Problem) -> bool:
    """Whether a fit is so poor that a mistake should be looked for."""
    accept = problem.plan.accept
    translation = fitted.get("translation_rms", 0.0)
    rotation = fitted.get("rotation_rms", 0.0)
    return translation > (accept.translation or DOUBTFUL_M) or rotation > (
        accept.rotation or DOUBTFUL_RAD
    )


def suspects(fit: Fit) -> tuple[Suspect, ...]:
    """Mistakes that explain the observations far better than a fit does, the best first."""
    problem = fit.problem
    rows = {int(row) for term in problem.terms for row in term.rows}
    if len(rows) < LEAST_ROWS or not problem.layout.poses:
        return ()
    found = [Suspect(what, mend, *_nothing()) for what, mend in _far_away(problem)]
    now = _errors(problem)
    tried = [
        Suspect(what, mend, *_errors(problem.with_observations(changed)))
        for what, mend, changed in _alternatives(problem)
    ]
    good = [one for one in tried if _far_better(one, now)]
    scale = None if good else _scale(problem, now) or _scale_of_fit(fit)
    if scale is not None:
        good.append(scale)
    if good:
        best = min(one.translation for one in good)
        good = [one for one in good if one.translation <= best / FAR_BETTER]
    return (*found, *sorted(good, key=lambda one: one.translation))


def _nothing() -> tuple[float, float]:
    return float("nan"), float("nan")


def _far_better(one: Suspect, now: tuple[float, float]) -> bool:
    translation = one.translation < FAR_BETTER * now[0]
    return translation and (np.isnan(now[1]) or one.rotation < FAR_BETTER * now[1])


def _errors(problem: Problem) -> tuple[float, float]:
    """Smallest median distance, m, and the angle with it, rad, over the algebraic solutions."""
    best = (np.inf, np.inf)
    for state in starts(problem, subsets=6).values():
        found = problem.residuals(state, np.zeros(problem.layout.count))
        distances, angles = [], []
        for term, (residual, _) in zip(problem.terms, found, strict=True):
            distances.append(np.linalg.norm(residual[:, :3], axis=1))
            if isinstance(term, PoseTerm):
                angles.append(np.linalg.norm(residual[:, 3:], axis=1))
        angle = float(np.median(np.concatenate(angles))) if angles else float("nan")
        best = min(best, (float(np.median(np.concatenate(distances))), angle))
    return best


def _alternatives(problem: Problem) -> Iterator[tuple[str, str, Observations]]:
    observations = problem.observations
    poses, flange = observations.camera_from_target, observations.flange
    if poses is not None:
        other = "world" if problem.plan.mount == "hand" else "hand"
        yield (
            "camera_from_target seems to be the camera in the target, or the camera is mounted "
            "otherwise than stated",
            "invert these poses (they must take the target's coordinates to the camera's), or "
            f"state camera: {{mount: {other}}}",
            replace(observations, camera_from_target=closed_form.inverse(poses)),
        )
        yield (
            "the quaternions of camera_from_target seem to be in the order x y z w",
            "exchange the headings: qw is the real part",
            replace(observations, camera_from_target=_reordered(poses)),
        )
    if problem.chain is None and flange is not None:
        yield (
            "flange.* seems to be the base in the flange: base and flange are swapped",
            "invert these poses: they must be the flange in the base",
            replace(observations, flange=closed_form.inverse(flange)),
        )
        yield (
            "the quaternions of flange.* seem to be in the order x y z w",
            "exchange the headings: qw is the real part",
            replace(observations, flange=_reordered(flange)),
        )
        if poses is not None:
            yield (
                "both flange.* and camera_from_target seem to be inverted",
                "invert both",
                replace(
                    observations,
                    flange=closed_form.inverse(flange),
                    camera_from_target=closed_form.inverse(poses),
                ),
            )
    if problem.chain is not None:
        yield from _joint_alternatives(problem, observations)


def _joint_alternatives(
    problem: Problem, observations: Observations
) -> Iterator[tuple[str, str, Observations]]:
    chain = problem.chain
    assert chain is not None
    turning = [n for n, turns in zip(chain.joints, chain.revolute, strict=True) if turns]
    largest = max((float(np.abs(observations.joints[n]).max()) for n in turning), default=0.0)
    if largest > _TURNS:
        degrees = {n: np.deg2rad(observations.joints[n]) for n in turning}
        yield (
            f"joint positions of up to {largest:.4g} rad seem to be in degrees",
            "multiply the joint columns by pi/180",
            replace(observations, joints={**observations.joints, **degrees}),
        )
    for name in chain.joints:
        mirrored = {**observations.joints, name: -observations.joints[name]}
        yield (
            f"joint {name} seems to turn the other way than the model's axis",
            f"negate the column joint.{name}, or the joint's <axis> in the model",
            replace(observations, joints=mirrored),
        )


def _reordered(poses: FloatArray) -> FloatArray:
    """Poses whose quaternions were written x y z w under the headings w x y z."""
    changed = poses.copy()
    there = np.isfinite(poses).all(axis=(1, 2))
    xyzw = Rotation.from_matrix(poses[there, :3, :3]).as_quat()
    # The columns held (w, x, y, z) = (read w, x, y, z); their meaning is (x, y, z, w).
    changed[there, :3, :3] = Rotation.from_quat(np.roll(xyzw, 1, axis=1)).as_matrix()
    return changed


def _scale(problem: Problem, now: tuple[float, float]) -> Suspect | None:
    """A factor of all measured positions: a unit, or the size of the target."""
    flange = predicted_poses(problem, problem.fixed)
    for term in problem.terms:
        if isinstance(term, PoseTerm) and len(term.rows) >= 4:
            mine, seen = flange[term.rows], seen_poses(term)
            factor, mounted, world = closed_form.scale_of_seen(mine, seen)
            seen = seen.copy()
            seen[:, :3, 3] *= factor
            gaps = (mine @ mounted)[:, :3, 3] - (world @ seen)[:, :3, 3]
            error = float(np.median(np.linalg.norm(gaps, axis=1)))
            column = "camera_from_target"
        elif isinstance(term, PointTerm) and len(term.rows) >= 8:
            factor, error = closed_form.scale_of_marker(flange[term.rows], term.measured)
            column = term.name
        else:
            continue
        if factor <= 0.0 or error > FAR_BETTER * now[0] or abs(factor - 1.0) < 1e-3:
            return None
        for known, unit in _SCALES.items():
            if abs(factor / known - 1.0) < 0.1:
                who = column if factor < 1.0 else "the robot's positions"
                return Suspect(
                    f"{who} seem to be in {unit} (a factor of {factor:.4g} fits)",
                    f"convert {who} to m",
                    error,
                    now[1],
                )
        return _of_target(factor, column, error, now[1])
    return None


def _scale_of_fit(fit: Fit) -> Suspect | None:
    """A factor of the target's positions beside all unknowns of the fit, to first order."""
    at = 0
    column = np.zeros(len(fit.jacobian))
    residuals = np.zeros(len(fit.jacobian))
    positions = np.zeros(len(fit.jacobian), dtype=bool)
    for term, kept, residual in zip(fit.problem.terms, fit.kept, fit.residuals, strict=True):
        size = np.array([fit.noise[name] for name in term.noise])
        count = residual.size
        residuals[at : at + count] = (residual * kept[:, None] / size).reshape(-1)
        if isinstance(term, PoseTerm):
            slope = np.zeros_like(residual)
            slope[:, :3] = -term.measured[:, :3, 3] * kept[:, None] / size[:3]
            column[at : at + count] = slope.reshape(-1)
            positions[at : at + count] = np.tile([True] * 3 + [False] * 3, len(residual))
        at += count
    if not positions.any():
        return None
    matrix = np.column_stack([fit.jacobian, column])
    change = np.linalg.lstsq(matrix, -residuals, rcond=1e-10)[0]
    left = residuals + matrix @ change
    factor = 1.0 + float(change[-1])
    part = float(np.linalg.norm(left[positions]) / np.linalg.norm(residuals[positions]))
    if part > FAR_BETTER or factor <= 0.0:
        return None
    usual = fit.noise["translation"] * part
    return _of_target(factor, "camera_from_target", usual, float("nan"))


def _of_target(factor: float, column: str, translation: float, rotation: float) -> Suspect:
    return Suspect(
        f"positions of {column} are too large or too small by a factor of {1 / factor:.4f}: the "
        "target is probably not of the stated size",
        f"multiply the target's dimensions by {factor:.4f} after measuring them",
        translation,
        rotation,
        factor,
    )


def _far_away(problem: Problem) -> Iterator[tuple[str, str]]:
    observations = problem.observations
    given = {
        "flange.*": observations.flange,
        "camera_from_target": observations.camera_from_target,
    }
    for name, poses in given.items():
        if poses is None:
            continue
        distance = float(np.nanmedian(np.linalg.norm(poses[:, :3, 3], axis=1)))
        if distance > FAR_AWAY_M:
            yield (
                f"{name} is {distance:.4g} m away: it seems to be in mm",
                f"divide {name} x, y and z by 1000",
            )
