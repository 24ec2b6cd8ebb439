"""Find input mistakes that would explain large errors: units, directions, signs.

Each is tested on a copy of the observations with an algebraic solver. None is applied; the user
corrects the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.input_mistake import FAR_BETTER, InputMistake
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.problem import CalibrationProblem
from pytest_twin.calibration.solve import Fit
from pytest_twin.calibration.starts import starts
from pytest_twin.calibration.terms import PoseTerm
from pytest_twin.calibration.wrong_scale import FreeScale, scale_of, wrong_scale
from pytest_twin.metrics.pose import inverse

DOUBTFUL_M = 0.003
"""RMS error of a fit above which mistakes are searched for if the plan accepts any error. It is
half of the smallest error that a wrong unit, direction or sign causes on an arm of 0.3 m."""

DOUBTFUL_RAD = 0.01
"""Rotation error from which the input is doubtful if the plan has no limit."""

LEAST_ROWS = 6
"""Fewest observations for finding mistakes, because a few poses fit with any mistake."""

FAR_AWAY_M = 20.0
"""A flange or a target farther away than this is assumed to be given in mm."""

_AS_GOOD = 1.2
"""Angles up to this many times as large are no worse: medians of a few poses differ by this."""

_ROUNDING_RAD = 1e-6
"""Rotation error of exact data, from rounding."""

_AS_TURNED_RAD = 0.1
"""A wrong scale leaves angles alone. Beyond this median error, rad, the poses are not of one time
or of one target, and a factor near 0 fits best whatever they are: it leaves no positions."""

_TURNS = 4 * np.pi
"""A joint reading beyond two revolutions, rad, may be in degrees."""


def has_large_errors(fitted: Mapping[str, float], problem: CalibrationProblem) -> bool:
    """Whether the errors of a fit are so large that mistakes should be searched for."""
    accept = problem.plan.accept
    translation = fitted.get("translation_rms", 0.0)
    rotation = fitted.get("rotation_rms", 0.0)
    return translation > (accept.translation or DOUBTFUL_M) or rotation > (
        accept.rotation or DOUBTFUL_RAD
    )


def find_mistakes(fit: Fit, of_corners: FreeScale | None = None) -> tuple[InputMistake, ...]:
    """Return mistakes that explain the observations far better than a fit does, the best first.

    Args:
        of_corners: scale of the target from the corners in images, if any.
    """
    problem = fit.problem
    rows = {int(row) for term in problem.terms for row in term.rows}
    if len(rows) < LEAST_ROWS or not problem.layout.poses:
        return ()
    in_millimetres = list(lengths_in_mm(problem))
    now = _errors(problem)
    tried = [
        InputMistake(what, mend, *_errors(problem.with_observations(changed)))
        for what, mend, changed in _alternatives(problem)
    ]
    good = [one for one in tried if _is_far_better(one, now)]
    good += [
        one
        for one in (
            InputMistake(what, mend, *_errors(problem.with_observations(changed)))
            for what, mend, changed in _wrong_signs(problem.observations, problem.chain is None)
        )
        # A sign of a position leaves the angles as they were.
        if one.translation < FAR_BETTER * now[0]
        and not one.rotation > _AS_GOOD * max(now[1], _ROUNDING_RAD)
    ]
    scale = None
    turned_alike = np.isnan(now[1]) or now[1] < _AS_TURNED_RAD
    if not good and not in_millimetres and not problem.plan.has_free_scale and turned_alike:
        scale = scale_of(problem, now) or wrong_scale(fit, of_corners)
    if scale is not None:
        good.append(scale)
    if good:
        best = min(one.translation for one in good)
        good = [one for one in good if one.translation <= best / FAR_BETTER]
    return (*in_millimetres, *sorted(good, key=lambda one: one.translation))


def lengths_in_mm(problem: CalibrationProblem) -> tuple[InputMistake, ...]:
    """Return the poses that are so far away that their positions must be in mm."""
    unknown = float("nan")
    return tuple(InputMistake(what, mend, unknown, unknown) for what, mend in _far_away(problem))


def _is_far_better(one: InputMistake, now: tuple[float, float]) -> bool:
    translation = one.translation < FAR_BETTER * now[0]
    return translation and (np.isnan(now[1]) or one.rotation < FAR_BETTER * now[1])


def _errors(problem: CalibrationProblem) -> tuple[float, float]:
    """Return the smallest median distance (m) over algebraic solutions, and its angle (rad)."""
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


def _alternatives(problem: CalibrationProblem) -> Iterator[tuple[str, str, Observations]]:
    observations = problem.observations
    poses, flange = observations.camera_from_target, observations.flange
    other = "world" if problem.plan.mount == "hand" else "hand"
    if poses is not None and observations.images is not None:
        yield (
            f"the camera is not mounted as stated (camera: {{mount: {problem.plan.mount}}})",
            f"state camera: {{mount: {other}}}",
            replace(observations, camera_from_target=inverse(poses)),
        )
    elif poses is not None:
        yield (
            "camera_from_target seems to be the camera in the target, or the camera is mounted "
            "otherwise than stated",
            "invert these poses (they must take the target's coordinates to the camera's), or "
            f"state camera: {{mount: {other}}}",
            replace(observations, camera_from_target=inverse(poses)),
        )
        yield (
            "the quaternions of camera_from_target seem to be in the order x y z w",
            "exchange the headings: qw is the real part",
            replace(observations, camera_from_target=_reorder_quaternions(poses)),
        )
    if problem.chain is None and flange is not None:
        yield (
            "flange.* seems to be the base in the flange: base and flange are swapped",
            "invert these poses: they must be the flange in the base",
            replace(observations, flange=inverse(flange)),
        )
        yield (
            "the quaternions of flange.* seem to be in the order x y z w",
            "exchange the headings: qw is the real part",
            replace(observations, flange=_reorder_quaternions(flange)),
        )
        if poses is not None and observations.images is None:
            yield (
                "both flange.* and camera_from_target seem to be inverted",
                "invert both",
                replace(
                    observations,
                    flange=inverse(flange),
                    camera_from_target=inverse(poses),
                ),
            )
    if problem.chain is not None:
        yield from _joint_alternatives(problem, observations)


def _wrong_signs(
    observations: Observations, flange_is_read: bool
) -> Iterator[tuple[str, str, Observations]]:
    """Axes of the measured poses or points that point the other way."""
    poses, points = observations.camera_from_target, observations.points
    if points:
        # Any mirrored axis gives the same points up to a rotation.
        mirrored = {name: values * [1.0, -1.0, 1.0] for name, values in points.items()}
        yield (
            "the points seem to be in a left-handed frame: one of its axes is mirrored",
            "negate one of the columns x, y, z of every point, the one whose axis is mirrored",
            replace(observations, points=mirrored),
        )
    if poses is None or observations.images is not None:
        return
    yield (
        "one of the axes of camera_from_target seems to be mirrored (a left-handed frame)",
        "negate the mirrored axis: of y these are the columns y, qx and qz",
        replace(observations, camera_from_target=_mirror_y(poses)),
    )
    columns = {"camera_from_target": poses}
    if flange_is_read and observations.flange is not None:
        columns["flange"] = observations.flange
    for column, read in columns.items():
        for at, axis in enumerate("xyz"):
            changed = read.copy()
            changed[:, at, 3] *= -1.0
            yield (
                f"{column}.{axis} seems to have the wrong sign",
                f"negate the column {column}.{axis}",
                replace(observations, **{column: changed}),  # type: ignore[arg-type]
            )


def _mirror_y(poses: FloatArray) -> FloatArray:
    """Poses with the y axis of both frames mirrored."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return np.asarray(mirror @ poses @ mirror)


def _joint_alternatives(
    problem: CalibrationProblem, observations: Observations
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


def _reorder_quaternions(poses: FloatArray) -> FloatArray:
    """Return poses with quaternions read as x y z w instead of w x y z."""
    changed = poses.copy()
    there = np.isfinite(poses).all(axis=(1, 2))
    xyzw = Rotation.from_matrix(poses[there, :3, :3]).as_quat()
    # The columns named w, x, y, z contain x, y, z, w.
    changed[there, :3, :3] = Rotation.from_quat(np.roll(xyzw, 1, axis=1)).as_matrix()
    return changed


def _far_away(problem: CalibrationProblem) -> Iterator[tuple[str, str]]:
    observations = problem.observations
    given = {
        "flange.*": observations.flange,
        "camera_from_target": observations.camera_from_target,
    }
    for name, poses in given.items():
        if poses is None or (name == "camera_from_target" and problem.plan.has_free_scale):
            continue
        distance = float(np.nanmedian(np.linalg.norm(poses[:, :3, 3], axis=1)))
        if distance > FAR_AWAY_M and name != "flange.*" and observations.images is not None:
            yield (
                f"the target is {distance:.4g} m away: its dimensions seem to be in mm",
                "state square and marker of target in m",
            )
        elif distance > FAR_AWAY_M:
            yield (
                f"{name} is {distance:.4g} m away: it seems to be in mm",
                f"divide {name} x, y and z by 1000",
            )
