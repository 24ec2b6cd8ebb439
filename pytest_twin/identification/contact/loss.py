"""Errors of simulated tosses against measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.contact.pushes import Push
from pytest_twin.identification.contact.tosses import Toss
from pytest_twin.metrics.pose_track import position_errors, rotation_errors
from pytest_twin.realization.free_body import FreeBody, poses_of

_LOST = 10.0
"""Position error assigned to samples of a diverged simulation, m."""


@dataclass(frozen=True)
class Stretch:
    """Segment of a toss that is simulated from its first sample.

    Attributes:
        state: (13,) initial pose and velocity.
        time: (n,) s, from 0.
        poses: (n, 7) measured poses: x y z (m), quaternion w x y z.
        push: external wrench on the object; its times count from the first sample.
    """

    state: FloatArray
    time: FloatArray
    poses: FloatArray
    push: Push | None = None


@dataclass(frozen=True)
class TossErrors:
    """Errors of predicted tosses; each is a mean over the samples of a toss.

    Attributes:
        position: (t,) m.
        rotation: (t,) rad.
    """

    position: FloatArray
    rotation: FloatArray


def whole_toss(toss: Toss) -> Stretch:
    """Return the segment of a whole toss."""
    return Stretch(toss.state(0), toss.time, toss.poses, toss.push)


def around_contacts(
    tosses: Sequence[Toss], gravity: FloatArray, samples: int, size: float
) -> list[list[Stretch]]:
    """Return short segments of each toss with a contact, beginning while the object moves.

    A contact is detected where the acceleration differs from gravity by half of it. Under an
    external push the object need not move: if it stays in place, that bounds the friction from
    below.

    Args:
        gravity: (3,) m/s^2.
        samples: number of samples of a segment, including the first.
        size: size of the object, m. A motion below a tenth of it in a segment counts as rest.
    """
    found = []
    for toss in tosses:
        rows = []
        change = np.diff(toss.twist[:, :3], axis=0) / np.diff(toss.time)[:, None]
        pushed = np.linalg.norm(change - gravity, axis=1) > 0.5 * np.linalg.norm(gravity)
        for row in range(1, len(toss.time) - samples + 1, max(1, samples // 2)):
            piece = slice(row, row + samples)
            seconds = toss.time[piece][-1] - toss.time[row]
            speed = np.linalg.norm(toss.twist[row, :3]) + size * np.linalg.norm(toss.twist[row, 3:])
            start = float(toss.time[row])
            acts = toss.push is not None and toss.push.acts(start, start + float(seconds))
            moves = speed * seconds > 0.1 * size
            if acts or (pushed[row : row + samples - 1].any() and moves):
                push = None if toss.push is None else toss.push.after(start)
                time = toss.time[piece] - start
                rows.append(Stretch(toss.state(row), time, toss.poses[piece], push))
        found.append(rows)
    return found


def errors_of(
    models: Sequence[mujoco.MjModel], body: FreeBody, stretches: Sequence[Stretch]
) -> list[TossErrors]:
    """Simulate every segment with every model and return the errors."""
    states = np.array([one.state for one in stretches])
    most = max(len(one.time) for one in stretches)
    times = np.full((len(stretches), most), np.nan)
    measured = np.full((len(stretches), most, 7), np.nan)
    for row, one in enumerate(stretches):
        times[row, : len(one.time)] = one.time
        measured[row, : len(one.time)] = one.poses
    asked = np.isfinite(times)
    found = []
    pushes = [None if one.push is None else (one.push.time, one.push.values) for one in stretches]
    for poses in poses_of(models, body, states, times, pushes):
        apart = np.where(np.isnan(poses[..., 0]), _LOST, position_errors(poses, measured))
        turned = np.where(np.isnan(poses[..., 3]), np.pi, rotation_errors(poses, measured))
        found.append(
            TossErrors(np.mean(apart, axis=1, where=asked), np.mean(turned, axis=1, where=asked))
        )
    return found


def losses(errors: TossErrors, size: float) -> FloatArray:
    """(t,) scalar error of each toss: position error over half width, plus rotation error.

    Both terms are about the displacement of the object's surface in half widths. Absolute and not
    squared errors are used, so that a simulated toss that ends on another face has limited weight.
    """
    return np.asarray(errors.position / size + errors.rotation)
