"""Leave out observations that repeat another one: the robot and the target have not moved.

A button that was pressed twice, or a recorder that ran while the robot was at rest, gives rows that
share the errors of robot and camera. Counted separately, they make intervals too narrow, and a
held-out copy of a fitted row tests nothing.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.cameras.images import Images
from pytest_twin.calibration.coincident_markers import ExcludedMeasurement
from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Plan

AT_REST_M, AT_REST_RAD = 1e-4, 2e-4
"""Changes of the robot's pose up to which it was at rest, m and rad. They exceed the resolution of
encoders and are as large as the repeatability of an arm: a return to a pose is no new pose."""

_NOISIEST, _APART, _DIAMETER, _MOST_ROWS = 20.0, 20.0, 5.0, 3000
"""Multiple of the changes at rest that noise of the encoders, or of a tracker of the flange, may
reach; ratio of the next larger change to it, and largest change within a group as a multiple of
its largest step, where the poses form groups; most rows that are grouped."""

SAME_TARGET_M, SAME_TARGET_RAD, SAME_TARGET_PX = 0.005, 0.02, 3.0
"""Changes of the measured target up to which only the noise of the measurement differs, m, rad and
px. Larger ones contradict the robot at rest; these rows are kept, and the fit excludes the wrong
one."""

_BY_IMAGE_PX = 0.5
"""Change of the corners in px up to which two images without a robot pose show the same view."""


def without_repeats(
    plan: Plan, observations: Observations, images: Images | None = None
) -> tuple[Observations, tuple[ExcludedMeasurement, ...]]:
    """Return the observations, each pose once, and the rows that were left out.

    The first row of each pose is kept.

    Raises:
        SpecError: the plan holds out a row whose copy is fitted.
    """
    robot = _robot(observations)
    first_of: dict[int, int] = {}
    if robot is None:
        _collect_same_views(observations, images, first_of)
    else:
        there = np.flatnonzero(np.isfinite(robot).all(axis=1))
        tree, at_rest = cKDTree(robot[there]), _change_at_rest(robot[there])
        for row in there.tolist():
            if row in first_of:
                continue
            near = there[tree.query_ball_point(robot[row], at_rest)]
            for other in near[near > row].tolist():
                if other not in first_of and _is_same(plan, observations, images, row, other):
                    first_of[other] = row
    if not first_of:
        return observations, ()
    _check_held_out(plan, observations, first_of)
    first_rows = [row for row in range(len(observations)) if row not in first_of]
    left_out = tuple(
        ExcludedMeasurement(
            observations.ids[row],
            f"the robot and the target as in {observations.ids[first_of[row]]}: counted once",
        )
        for row in sorted(first_of)
    )
    return observations.rows(first_rows), left_out


def _robot(observations: Observations) -> FloatArray | None:
    """(rows, k) coordinates of the robot, of which ``AT_REST_RAD`` is a distance at rest."""
    if observations.joints:
        return np.stack(list(observations.joints.values()), axis=1)
    if observations.flange is None:
        return None
    places = observations.flange[:, :3, 3] * (AT_REST_RAD / AT_REST_M)
    # The Frobenius distance of two rotations is the angle times the root of two.
    turns = observations.flange[:, :3, :3].reshape(-1, 9) / np.sqrt(2.0)
    return np.concatenate([places, turns], axis=1)


def _change_at_rest(robot: FloatArray) -> float:
    """Distance of two rows up to which the robot was at rest.

    Where it was at rest with noisy encoders, the rows form groups whose steps (single linkage) are
    far below the distances between groups.
    """
    if not 2 < len(robot) <= _MOST_ROWS:
        return AT_REST_RAD
    steps = linkage(robot, "single")[:, 2]
    noise = steps[steps <= _NOISIEST * AT_REST_RAD]
    moves = steps[steps > _NOISIEST * AT_REST_RAD]
    if not (len(noise) and len(moves) and moves.min() > _APART * noise.max()):
        return AT_REST_RAD
    return max(AT_REST_RAD, _DIAMETER * float(noise.max()))


def _is_same(
    plan: Plan, observations: Observations, images: Images | None, row: int, other: int
) -> bool:
    """Whether two rows of one robot pose measured the same."""
    for names in (observations.payloads, observations.pivots):
        if names is not None and names[row] != names[other]:
            return False
    poses = observations.camera_from_target
    if poses is not None and np.isfinite(poses[[row, other]]).all():
        turn = Rotation.from_matrix(poses[row, :3, :3].T @ poses[other, :3, :3])
        if turn.magnitude() > SAME_TARGET_RAD:
            return False
        # The unit of a camera without a metric scale is unknown.
        shift = float(np.linalg.norm(poses[row, :3, 3] - poses[other, :3, 3]))
        if shift > SAME_TARGET_M and not plan.has_free_scale:
            return False
    for places in observations.points.values():
        if np.linalg.norm(places[row] - places[other]) > SAME_TARGET_M:
            return False
    moved = _corners_moved(images, observations.ids[row], observations.ids[other])
    return not moved > SAME_TARGET_PX


def _collect_same_views(
    observations: Observations, images: Images | None, first_of: dict[int, int]
) -> None:
    """Add the images without a robot pose that show the same view as an earlier one."""
    if images is None:
        return
    rows = [row for row, one in enumerate(observations.ids) if one in images.detections]
    centres = np.array(
        [images.detections[observations.ids[row]].pixels.mean(axis=0) for row in rows]
    ).reshape(-1, 2)
    for at, row in enumerate(rows):
        if row in first_of:
            continue
        # Images with other visible corners have other centres, so this bound is wide.
        near = np.flatnonzero(
            np.linalg.norm(centres[at + 1 :] - centres[at], axis=1) < 10 * SAME_TARGET_PX
        )
        for other in (rows[at + 1 + one] for one in near.tolist()):
            moved = _corners_moved(images, observations.ids[row], observations.ids[other])
            if other not in first_of and moved < _BY_IMAGE_PX:
                first_of[other] = row


def _corners_moved(images: Images | None, one: str, other: str) -> float:
    """Median shift of the corners that two images both show, px; NaN if there are none."""
    if images is None or not {one, other} <= set(images.detections):
        return float("nan")
    first, second = images.detections[one], images.detections[other]
    _, at, beside = np.intersect1d(first.corner_ids, second.corner_ids, return_indices=True)
    if len(at) == 0:
        return float("nan")
    return float(np.median(np.linalg.norm(first.pixels[at] - second.pixels[beside], axis=1)))


def _check_held_out(plan: Plan, observations: Observations, first_of: dict[int, int]) -> None:
    wanted: Collection[str] = set(plan.hold_out.ids or ())
    for row, first in first_of.items():
        name, copied = observations.ids[row], observations.ids[first]
        if (name in wanted) != (copied in wanted) and wanted:
            held, fitted = (name, copied) if name in wanted else (copied, name)
            raise plan.error(
                "hold_out.ids",
                f"observation {held} is held out and repeats {fitted}, which is fitted: the robot "
                "and the target have not moved",
                value=held,
                expected=f"both {held} and {fitted}, or neither",
            )
