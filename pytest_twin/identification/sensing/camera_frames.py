"""Estimate the delay of a camera against the joints, from rotations of the observed target.

Between two frames, a target on the hand rotates by the same angle as the hand, as observed by a
fixed camera. The axes differ by a constant rotation X (the target's mounting): the rotation vectors
``a_k`` of the target and ``b_k(d)`` of the hand, ``d`` earlier, satisfy ``a_k = X b_k(d)``. For a
camera on the hand and a fixed target, the rotation is inverted. No calibration of the camera is
needed (Tsai, Lenz, 1989, with the clock offset as a further unknown).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation, Slerp

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.ros_serialization import Integers
from pytest_twin.realization import Realization
from pytest_twin.realization.ideal_sensors import orientations_at
from pytest_twin.sensors.camera import CameraTiming, frames_of
from pytest_twin.sensors.linear import in_blocks

MOST_DELAY_S = 0.3
"""Largest magnitude of the delay."""
_TURN_S = 0.15
"""Time between the orientations of a rotation. At 1 rad/s the rotation is 9 degrees, far above the
noise of a pose."""
_FEWEST = 50
"""Smallest number of samples of joints and of poses."""


@dataclass(frozen=True)
class CameraTrial:
    """One recording of observed target orientations and joint motion.

    Attributes:
        stamps: (n,) stamps of the frames, s.
        seen: n orientations of the target in the camera.
        turns: orientations of the frame in the world, interpolated over the joints' time, s.
        role: role stated by the recording.
        steps: joint -> quantization of its encoder, rad or m.
    """

    path: Path
    stamps: FloatArray
    seen: Rotation
    turns: Slerp
    role: str | None = None
    steps: Mapping[str, float] = field(default_factory=dict)


def frames_seen(
    path: Path,
    frame: str,
    stamps: Integers,
    poses: FloatArray,
    joints: JointSeries,
    names: Sequence[str],
    realization: Realization,
) -> CameraTrial:
    """Return the frames within the time range of the joint states.

    Args:
        frame: site or body that carries the camera or its target.
        stamps: (n,) stamps, ns.
        poses: (n, 7) target in the camera: x y z (m), quaternion x y z w.
        names: names of the joints that the model has.

    Raises:
        RecordingError: too few frames while the joints were recorded.
    """
    assert joints.position is not None
    zero = int(min(stamps.min(), joints.stamp.min()))
    columns = [joints.names.index(name) for name in names]
    known = np.isfinite(joints.position[:, columns]).all(axis=1)
    _, rows = np.unique(joints.stamp[known], return_index=True)
    position = joints.position[known][rows][:, columns]
    time = np.asarray((joints.stamp[known][rows] - zero) * 1e-9, dtype=np.float64)
    _, order = np.unique(stamps, return_index=True)
    at = np.asarray((stamps[order] - zero) * 1e-9, dtype=np.float64)
    if len(time):
        inside = (at > time[0] + MOST_DELAY_S) & (at < time[-1] - MOST_DELAY_S)
        at, order = at[inside], order[inside]
    if len(at) < _FEWEST or len(time) < _FEWEST:
        raise RecordingError(
            "too few frames while the joints were recorded", path=path, value=len(at),
            expected=f"at least {_FEWEST}",
        )  # fmt: skip
    turns = Rotation.from_matrix(orientations_at(realization, frame, tuple(names), position))
    return CameraTrial(path, at, Rotation.from_quat(poses[order, 3:]), Slerp(time, turns))


@dataclass(frozen=True)
class Delay:
    """Estimated delay of a camera.

    Attributes:
        timing: delay and frame rate.
        deviation: standard deviation of the delay, s.
        mount: ``world`` for a fixed camera, ``hand`` for one that moves with the frame.
        blocks: number of time blocks from which the deviation was computed.
    """

    timing: CameraTiming
    deviation: float
    mount: str
    blocks: int


def delay_of(trials: Sequence[CameraTrial]) -> Delay:
    """Return the delay with the smallest squared difference of hand and target rotations.

    Raises:
        RecordingError: the hand hardly rotates, or the target does not rotate with it.
    """
    found = {mount: _least(trials, mount) for mount in ("world", "hand")}
    mount = min(found, key=lambda one: found[one][1])
    delay, cost = found[mount]
    turned = float(sum(np.sum(_turns(one, 0.0, mount)[0] ** 2) for one in trials))
    if not cost < 0.5 * turned or abs(delay) > 0.99 * MOST_DELAY_S:
        raise RecordingError(
            "the target does not rotate as the frame does", path=trials[0].path,
            value=f"{100.0 * np.sqrt(cost / max(turned, 1e-300)):.0f} % of the turns are left at "
            f"the best delay, {1e3 * delay:.0f} ms",
            expected=f"a camera whose delay is below {1e3 * MOST_DELAY_S:.0f} ms, and joints that "
            "turn the frame about two axes",
        )  # fmt: skip
    step = 2e-3
    errors, numbers = _errors(trials, delay, mount)
    slope = (_errors(trials, delay + step, mount)[0] - _errors(trials, delay - step, mount)[0]) / (
        2.0 * step
    )
    # The constant rotation is solved again for each delay, so the derivative already includes its
    # change.
    blocks = np.array(in_blocks(numbers))
    scores = np.sum(slope * errors, axis=1)
    count = int(blocks.max()) + 1
    sums = np.array([scores[blocks == one].sum() for one in range(count)])
    deviation = float(np.sqrt(count / (count - 1) * np.sum(sums**2)) / np.sum(slope**2))
    frames = np.array([frames_of(one.stamps) for one in trials])
    weight = np.array([len(one.stamps) for one in trials], dtype=float)
    period, jitter, lost = (frames.T @ weight / weight.sum()).tolist()
    return Delay(CameraTiming(delay, period, jitter, lost), deviation, mount, count)


def turn_errors(trials: Sequence[CameraTrial], delay: float, mount: str) -> float:
    """RMS difference of hand and target rotations at a delay, rad."""
    errors, _ = _errors(trials, delay, mount)
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _least(trials: Sequence[CameraTrial], mount: str) -> tuple[float, float]:
    def cost(delay: float) -> float:
        return float(np.sum(_errors(trials, delay, mount)[0] ** 2))

    grid = np.linspace(-MOST_DELAY_S, MOST_DELAY_S, 61)
    costs = [cost(float(one)) for one in grid]
    at = int(np.argmin(costs))
    low, high = grid[max(0, at - 1)], grid[min(len(grid) - 1, at + 1)]
    best = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    return float(best.x), float(best.fun)


def _errors(
    trials: Sequence[CameraTrial], delay: float, mount: str
) -> tuple[FloatArray, list[int]]:
    """(n, 3) rotation vectors of target minus hand, rad, and the number of each trial.

    Each recording has its own mounting rotation, since the board may have been remounted.
    """
    errors = []
    for trial in trials:
        seen, made = _turns(trial, delay, mount)
        fitted, _ = Rotation.align_vectors(seen, made)
        errors.append(seen - fitted.apply(made))
    return np.vstack(errors), [len(one) for one in errors]


def _turns(trial: CameraTrial, delay: float, mount: str) -> tuple[FloatArray, FloatArray]:
    """(n, 3) rotation vectors of the target and of the hand over the same times, rad."""
    apart = max(1, round(_TURN_S / float(np.median(np.diff(trial.stamps)))))
    hand = CameraTiming(delay, 0.0, 0.0, 0.0).seen(trial.stamps, trial.turns)
    target = trial.seen.inv() if mount == "hand" else trial.seen
    return (
        (target[:-apart].inv() * target[apart:]).as_rotvec(),
        (hand[:-apart].inv() * hand[apart:]).as_rotvec(),
    )
