"""Motion of a floating base along its recorded poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.formats.base_pose import BasePoses

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

# Poses that determine a smooth motion.
_FEWEST = 10
# Usual intervals without a pose that are bridged, at the ends and between poses.
_BRIDGED = 5.0
# Residual of the smooth motion, in standard deviations of the noise, the order of the differences
# that show this noise, and the stiffness of a spline below which it meets all values.
_FARTHEST, _ORDER, _SOFTEST = 1.5, 6, 1e-18
# A step of this many usual steps, and of this size (m or rad), is a new map and no motion.
_JUMP, _JUMP_SIZE = 30.0, 0.05


@dataclass(frozen=True)
class BaseMotion:
    """Smooth motion of a floating base in the world.

    The poses are measured, and their noise would be accelerations: a smoothing spline, whose
    stiffness generalized cross-validation chooses, follows them.

    Attributes:
        source: topic or columns of the poses.
        frame: name of the frame whose pose was recorded; may be empty.
        time: (k,) s from the first state.
        position: (k, 3) m.
        quaternion: (k, 4) w x y z, base to world, neighbours with the same sign.
    """

    source: str
    frame: str
    time: FloatArray
    position: FloatArray
    quaternion: FloatArray

    def shifted(self, seconds: float) -> BaseMotion:
        """The same motion on a clock that begins ``seconds`` later."""
        return replace(self, time=self.time - seconds)

    def at(self, time: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 3) position, m, and (n, 4) quaternion w x y z at each time, s."""
        inside = np.clip(time, self.time[0], self.time[-1])
        position, quaternion = self._curves
        poses: FloatArray = position(inside) + (time - inside)[:, None] * position(inside, 1)
        turned = quaternion(inside)
        return poses, turned / np.linalg.norm(turned, axis=1, keepdims=True)

    def note(self) -> str:
        """What the replay does with the poses, and how far the smooth motion is from them."""
        position, quaternion = self.at(self.time)
        offset = float(np.sqrt(np.mean(np.sum((position - self.position) ** 2, axis=1))))
        cosine = np.clip(np.abs((quaternion * self.quaternion).sum(axis=1)), 0.0, 1.0)
        angle = float(np.sqrt(np.mean((2.0 * np.arccos(cosine)) ** 2)))
        return (
            f"the base moves along the {len(self.time)} poses of {self.source}, smoothed by "
            f"{1e3 * offset:.3g} mm and {1e3 * angle:.3g} mrad (RMS)"
        )

    @cached_property
    def _curves(self) -> tuple[BSpline, BSpline]:
        return _smoothed(self.time, self.position), _smoothed(self.time, self.quaternion)


def _smoothed(time: FloatArray, values: FloatArray) -> BSpline:
    """Spline through (k, n) values that is no farther from them than their noise explains.

    The minimum of cross-validation may be at a stiffness that follows no motion; the stiffness is
    then the largest one whose residual is that of the noise.
    """
    from scipy.interpolate import make_smoothing_spline

    allowed = _FARTHEST * _noise(values)
    found = make_smoothing_spline(time, values)
    stiffness = float(time[-1] - time[0]) ** 3
    while np.sqrt(np.mean((found(time) - values) ** 2)) > allowed and stiffness > 0.0:
        stiffness = 0.1 * stiffness if stiffness > _SOFTEST else 0.0
        found = make_smoothing_spline(time, values, lam=stiffness)
    return found


def _noise(values: FloatArray) -> float:
    """Standard deviation of white noise, from differences of such an order that motion has none."""
    differences = np.diff(values, _ORDER, axis=0)
    return float(np.sqrt(np.mean(differences**2) / comb(2 * _ORDER, _ORDER)))


def base_motion(poses: BasePoses, start: int, duration: float, path: Path) -> BaseMotion:
    """Return the motion of the base during a trial.

    Args:
        start: stamp of the first state, ns.
        duration: time from the first to the last state or command, s.
        path: the recording, for errors.

    Raises:
        RecordingError: the poses do not cover the trial, or jump.
    """
    time = np.asarray((poses.stamp - start) * 1e-9, dtype=np.float64)
    usual = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    near = (time > -_BRIDGED * usual - 1.0) & (time < duration + _BRIDGED * usual + 1.0)
    motion = BaseMotion(
        poses.source, poses.frame, time[near], poses.position[near], poses.quaternion[near]
    )
    _refuse_missing(motion, usual, duration, path)
    _refuse_jumps(motion, path)
    return motion


def _refuse_missing(motion: BaseMotion, usual: float, duration: float, path: Path) -> None:
    problem = value = ""
    if len(motion.time) < _FEWEST:
        problem, value = "too few poses of the base", f"{len(motion.time)} poses"
    elif motion.time[0] > _BRIDGED * usual or motion.time[-1] < duration - _BRIDGED * usual:
        problem = "poses of the base do not cover the recording"
        value = f"poses from {motion.time[0]:.4g} to {motion.time[-1]:.4g} s"
    else:
        steps = np.diff(motion.time)
        longest = int(np.argmax(steps))
        if steps[longest] > _BRIDGED * usual:
            problem = "poses of the base are missing"
            value = f"none for {steps[longest]:.4g} s after {motion.time[longest]:.4g} s"
    if problem:
        raise RecordingError(
            problem, path=path, where=motion.source, value=value,
            expected=f"poses from 0 to {duration:.4g} s, about every {usual:.3g} s, on the clock "
            "of the joint states; or --base fixed for a robot in a rig",
        )  # fmt: skip


def _refuse_jumps(motion: BaseMotion, path: Path) -> None:
    for what, unit, values in (
        ("position", "m", motion.position),
        ("orientation", "rad", 2.0 * motion.quaternion),
    ):
        steps = np.linalg.norm(np.diff(values, axis=0), axis=1)
        largest = int(np.argmax(steps))
        least = max(_JUMP_SIZE, _JUMP * float(np.median(steps)))
        if steps[largest] > least:
            raise RecordingError(
                f"the {what} of the base jumps", path=path, where=motion.source,
                value=f"{steps[largest]:.4g} at {motion.time[largest + 1]:.4g} s", unit=unit,
                expected="a continuous pose, such as odometry instead of a map's correction",
            )  # fmt: skip
