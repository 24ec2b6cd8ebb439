"""Choose poses at rest that determine gravity parameters (greedy D-optimal design)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.excitation.motion import JointStates, Path
from pytest_twin.identification.regressor.base_parameters import BaseParameters, base_of
from pytest_twin.identification.regressor.regressor import Regressor

DWELL = 0.4
"""Time at rest in each pose, s."""
SETTLE = 0.1
"""Time after a move in which efforts are ignored, s."""
APPROACH = 0.02
"""Distance of the approach to each pose from both sides, which cancels dry friction, rad or m."""
_CANDIDATES = 120
"""Number of random poses from which poses are chosen."""
_ON_THE_WAY = 6
"""Number of poses on the path to a candidate at which distances are checked."""
_RIDGE = 1e-6
"""Information that is assumed for each parameter, as a fraction of that of a mean pose."""


def static_base(regressor: Regressor, approved: ApprovedLimits) -> BaseParameters:
    """Return the base parameters that poses at rest determine: gravity and constant efforts."""
    poses = random_poses(regressor, approved)
    return base_of(static_matrix(regressor, poses), regressor.columns)


def random_poses(regressor: Regressor, approved: ApprovedLimits) -> FloatArray:
    """Return (n, joints) random poses in the approved range, enough to separate all columns."""
    lower, upper = approved.room
    count = max(40, 4 * len(regressor.columns) // len(approved.joints))
    return np.random.default_rng(0).uniform(lower, upper, (count, len(approved.joints)))


def static_matrix(regressor: Regressor, poses: FloatArray) -> FloatArray:
    """Return the (n, joints, p) regressor of poses (n, joints) at rest."""
    still = np.zeros_like(poses)
    return regressor.matrix(poses, still, still)


def grid(
    approved: ApprovedLimits,
    regressor: Regressor,
    std: FloatArray,
    is_clear: Callable[[FloatArray], bool],
) -> Callable[[float, int], JointStates]:
    """Return a design of poses at rest, each approached from both sides.

    Each next pose adds most to log det of the information about the static base parameters
    (greedy D-optimal design; Fedorov, Theory of Optimal Experiments, 1972). Candidates are random
    poses that straight lines in joint space connect to the last pose and to the start. The number
    of poses is limited by the duration.

    Args:
        std: (joints,) standard deviation of the effort's noise, N*m or N.
        is_clear: whether a pose (j,) satisfies distances and boxes.
    """
    base = static_base(regressor, approved)

    def make(scale: float, seed: int) -> JointStates:
        random = np.random.default_rng(seed)
        lower, upper = approved.room
        start = approved.start
        low = start + scale * (lower - start) + APPROACH * scale
        high = start + scale * (upper - start) - APPROACH * scale
        low, high = np.minimum(low, start), np.maximum(high, start)
        poses = random.uniform(low, high, (_CANDIDATES, len(start)))
        weighted = base.matrix(static_matrix(regressor, poses)) / std[:, None]
        ridge = _RIDGE * float(np.einsum("njb,njb->", weighted, weighted)) / len(poses)
        information = ridge * np.eye(len(base))
        approach = np.minimum(APPROACH * scale, 0.1 * (upper - lower))
        # Scale the speed too: overshoot of a servo exceeds the speed limit on moves of any length.
        speed, acceleration = scale * approved.speed, scale * approved.acceleration
        path = Path(start, speed, acceleration, approved.rate)
        path.dwell(0.5 / approved.band[1])
        chosen: list[FloatArray] = []
        free = list(range(len(poses)))
        at = start
        while free:
            nearer = np.linalg.inv(information)
            gains = [
                np.linalg.slogdet(np.eye(len(start)) + weighted[i] @ nearer @ weighted[i].T)[1]
                for i in free
            ]
            found = _first_reachable(
                [free[i] for i in np.argsort(gains)[::-1]], poses, at, start, is_clear
            )
            if found is None:
                break
            free.remove(found)
            pose = poses[found]
            if not _fits(path, approved, pose, approach, scale):
                # A nearer pose may still fit, so try a few more.
                if len(free) < len(poses) // 2:
                    break
                continue
            for side in (-1.0, 1.0):
                path.move(pose + side * approach)
                path.move(pose)
                path.dwell(DWELL)
            information = information + weighted[found].T @ weighted[found]
            chosen.append(pose)
            at = pose
        path.move(start)
        path.dwell(0.5 / approved.band[1])
        return path.states().described(poses=[pose.tolist() for pose in chosen], dwell=DWELL)

    return make


def _first_reachable(
    order: list[int],
    poses: FloatArray,
    at: FloatArray,
    start: FloatArray,
    is_clear: Callable[[FloatArray], bool],
) -> int | None:
    for index in order[:20]:
        pose = poses[index]
        ways = (at, start) if not np.array_equal(at, start) else (start,)
        if all(
            is_clear(begin + share * (pose - begin))
            for begin in ways
            for share in np.linspace(1.0, 0.0, _ON_THE_WAY, endpoint=False)
        ):
            return index
    return None


def _fits(
    path: Path, approved: ApprovedLimits, pose: FloatArray, approach: FloatArray, scale: float
) -> bool:
    """Whether a pose and the return to the start fit in the remaining time."""
    there = path.time_to(pose)
    small = Path(pose, scale * approved.speed, scale * approved.acceleration, approved.rate)
    near = small.time_to(pose + approach)
    back = small.time_to(approved.start)
    needed = there + 5.0 * near + 2.0 * (DWELL + 1.0 / approved.rate) + back
    return path.seconds + needed + 1.0 / approved.band[1] <= approved.duration
