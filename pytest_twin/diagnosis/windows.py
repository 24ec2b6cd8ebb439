"""Trials in the model's terms: whole, or in short windows where errors would grow.

Under an effort command errors integrate twice, and a servo that hunts or an arm that falls does not
do the same twice: a simulation is held to the recording for a while, then starts anew from the
measured state (multiple shooting; Bock, 1981).
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.smoothing import SMOOTH, derivatives, smooth_state
from pytest_twin.diagnosis.unrecorded import Around
from pytest_twin.effects.base import FloatArray
from pytest_twin.effects.segment import Segment
from pytest_twin.realization import Realization
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.mjcf import compiled
from pytest_twin.trial import CommandMode, Trial

WINDOW = 0.5
"""s, of windows, where motions are not too wild for it."""
_START_SAMPLES, _FEWEST_SAMPLES = 12, 8
# s by which a first command may be late and be held from the start.
_LATE = 0.05
# Mean square, of its usual size, by which samples are off a smooth motion where a command jumps;
# the median of the squares of a unit normal distribution.
_ROUGH, _MEDIAN_SQUARE = 4.0, 0.455


def segments_of(
    realization: Realization,
    trial: Trial,
    index: int,
    joints: Sequence[str],
    window: float | None = None,
    coldness: float = 1.0,
    *,
    moving: bool = False,
    commanded: bool = False,
) -> list[Segment]:
    """A trial in the model's terms: one segment, or short windows.

    Args:
        realization: what it is stepped on, under the trial's own controller and payload.
        trial: what was recorded.
        index: of the trial, kept in its segments.
        joints: columns; all are in the trial.
        window: s; by default effort commands have :data:`WINDOW`, others none.
        coldness: of the trial, as its segments have it.
        moving: whether a whole trial without velocities begins with what its first samples say, and
            not at rest.
        commanded: whether what lies well before the first command is left out: what the robot was
            told until then is in no recording.

    Raises:
        SpecError: a controller or payload that the model lacks.
    """
    recorded = _recorded(realization, trial, joints)
    first = recorded.first_commanded if commanded else 0
    more = {"trial": index, "coldness": coldness}
    if window is None and trial.command_mode != "effort":
        return [_whole(recorded, first, moving, more)]
    return _windows(recorded, first, window or WINDOW, more)


@dataclass(frozen=True, slots=True)
class _Recorded:
    """A trial in the model's terms: stamps ascend, s on its clock; commands are NaN where a joint
    has none.
    """

    model: mujoco.MjModel
    joints: tuple[str, ...]
    mode: CommandMode
    time: FloatArray
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray | None
    command_time: FloatArray
    command: FloatArray

    @property
    def first_commanded(self) -> int:
        """Number of the first sample under a command; 0 where none is well before it, or hardly any
        are left.
        """
        first = int(np.searchsorted(self.time, self.command_time[0]))
        late = self.command_time[0] > self.time[0] + _LATE
        return first if late and len(self.time) - first >= _FEWEST_SAMPLES else 0

    def around(self, position: FloatArray, velocity: FloatArray) -> Around:
        """The rest of the model, along a motion."""
        return Around(
            self.model, self.joints, self.mode, self.command_time, self.command,
            (self.time, position, velocity),
        )  # fmt: skip

    def segment(self, inside: NDArray[np.bool_], **more: Any) -> Segment:
        """The samples ``inside``."""
        return Segment(
            model=self.model,
            mode=self.mode,
            time=self.time[inside],
            position=self.position[inside],
            velocity=None if self.velocity is None else self.velocity[inside],
            effort=None if self.effort is None else self.effort[inside],
            command_time=self.command_time,
            command=self.command,
            **more,
        )


def _recorded(realization: Realization, trial: Trial, joints: Sequence[str]) -> _Recorded:
    columns = [trial.joints.index(j) for j in joints]
    encoders = Encoders.of(calibration_of(realization), joints)
    keep = np.concatenate([[True], np.diff(trial.time) > 0])
    command = np.full((len(trial.command_time), len(joints)), np.nan)
    for j, joint in enumerate(joints):
        if joint in trial.command_joints:
            command[:, j] = trial.command[:, trial.command_joints.index(joint)]
    command = encoders.model_command(command, trial.command_mode)
    ascending = np.concatenate([[True], np.diff(trial.command_time) > 0])
    return _Recorded(
        _model(realization, trial),
        tuple(joints),
        trial.command_mode,
        trial.time[keep],
        encoders.model_position(trial.position[keep][:, columns]),
        _columns(trial.velocity, keep, columns, encoders),
        _columns(trial.effort, keep, columns, encoders),
        trial.command_time[ascending],
        command[ascending],
    )


def _whole(recorded: _Recorded, first: int, moving: bool, more: Mapping[str, Any]) -> Segment:
    """From the sample ``first`` to the last."""
    time, position = recorded.time, recorded.position
    start = float(time[first]) if first else 0.0
    if recorded.velocity is not None:
        velocity = np.nan_to_num(recorded.velocity[first])
    elif moving:
        velocity = smooth_state(time[first:], position[first:], start, 2.0 * SMOOTH)[1]
    else:
        velocity = np.zeros(len(recorded.joints))
    around = recorded.around(position, np.zeros_like(position))
    (rest,) = around.at([start], [(position[first], velocity)])
    return recorded.segment(
        np.arange(len(time)) >= first, start=start, initial_position=position[first],
        initial_velocity=velocity, unrecorded=rest, **more,
    )  # fmt: skip


def _windows(
    recorded: _Recorded, first: int, window: float, more: Mapping[str, Any]
) -> list[Segment]:
    """Windows of about ``window`` s, from the sample ``first`` on."""
    time, position = recorded.time, recorded.position
    width = start_width(time)
    smooth, speed, _ = derivatives(time, position, width)
    edges = edges_of(time, position - smooth, window)
    spans = [
        (float(start), (time >= start) & (time <= end))
        for start, end in itertools.pairwise(edges)
        if start >= time[first]
    ]
    spans = [(start, inside) for start, inside in spans if inside.sum() >= _FEWEST_SAMPLES]
    states = [smooth_state(time, position, start, width) for start, _ in spans]
    rests = recorded.around(smooth, speed).at([start for start, _ in spans], states)
    return [
        recorded.segment(
            inside, start=start, initial_position=q, initial_velocity=v,
            history=(time, smooth, speed), unrecorded=rest, **more,
        )
        for (start, inside), (q, v), rest in zip(spans, states, rests, strict=True)
    ]  # fmt: skip


def edges_of(time: FloatArray, off: FloatArray, window: float) -> FloatArray:
    """Where windows begin and end, s.

    A velocity is not known where a command jumps: there, they begin a little before or after.

    Args:
        time: (n,) s, from 0 on.
        off: (n, joints) samples less a smooth motion.
        window: s, about.
    """
    count = max(1, round(time[-1] / window))
    edges = np.linspace(0.0, time[-1], count + 1)
    usual = np.maximum(np.median(off**2, axis=0), 1e-30) / _MEDIAN_SQUARE
    rough = (off**2 / usual).max(axis=1)
    level = np.convolve(rough, np.ones(_START_SAMPLES) / _START_SAMPLES, mode="same")
    for k in range(1, count):
        near = np.flatnonzero(np.abs(time - edges[k]) <= window / 4.0)
        near = near[np.argsort(np.abs(time[near] - edges[k]))]
        if len(near) and level[near[0]] > _ROUGH:
            smooth = near[level[near] <= _ROUGH]
            edges[k] = time[smooth[0] if len(smooth) else near[np.argmin(level[near])]]
    return edges


def _columns(
    values: FloatArray | None, keep: NDArray[np.bool_], columns: list[int], encoders: Encoders
) -> FloatArray | None:
    return None if values is None else encoders.signed(values[keep][:, columns])


_MODELS: weakref.WeakKeyDictionary[Realization, dict[tuple[str | None, ...], mujoco.MjModel]] = (
    weakref.WeakKeyDictionary()
)


def _model(realization: Realization, trial: Trial) -> mujoco.MjModel:
    """What a trial is stepped on: one model for all trials of a controller and a payload."""
    twin = realization.twin
    chosen: list[str | None] = [None, None]
    if twin is not None:
        controller, payload = (trial.metadata.get(key) for key in ("controller", "payload"))
        chosen = [
            controller if controller in twin.controllers else None,
            payload if payload in twin.payloads else None,
        ]
    known = _MODELS.setdefault(realization, {})
    if tuple(chosen) not in known:
        spec = realization.variant(*chosen).spec.copy()
        for body in spec.bodies:
            # MuJoCo's shortcut for bodies that turn about their centre: effects move centres.
            body.simple = 0
        known[tuple(chosen)] = compiled(spec)[0]
    return known[tuple(chosen)]


def start_width(time: FloatArray) -> float:
    """Seconds of samples that a window's initial state is taken from."""
    return _START_SAMPLES * float(np.median(np.diff(time)))
