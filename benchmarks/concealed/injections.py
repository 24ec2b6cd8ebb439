"""Inject effects into recordings: exact changes of stamps and readings, as pure functions.

Each function maps a recording of a real machine to the recording of the same machine with an
additional error. Nothing is simulated, so noise and unmodelled physics are real. Each docstring
states the exact equation between the old and the new values.

Stamps are ns, so a shift is exact to 1 ns. Log times move with the stamps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pytest_twin.formats.recording import JointSeries

Floats = np.ndarray[Any, np.dtype[np.float64]]
Rows = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True)
class Recorded:
    """States and commands of one recording.

    Attributes:
        state, command: the two topics.
        metadata: metadata of the trial: role, controller, ...
    """

    state: JointSeries
    command: JointSeries
    metadata: dict[str, str]


def late_states(recorded: Recorded, seconds: float) -> Recorded:
    """Stamp each state ``seconds`` late: measured(t) = state(t - seconds)."""
    return replace(recorded, state=_moved(recorded.state, seconds))


def late_drive(recorded: Recorded, seconds: float) -> Recorded:
    """Stamp each command ``seconds`` early: the drive acts on command(t - seconds)."""
    return replace(recorded, command=_moved(recorded.command, -seconds))


def late_drive_of(recorded: Recorded, joint: str, samples: int) -> Recorded:
    """Shift one joint's commands by ``samples`` messages, so that this drive acts late.

    The last ``samples`` commands of all joints are left out: the log has no later ones.
    """
    series = recorded.command
    column = series.names.index(joint)
    count = len(series.stamp) - samples

    def ahead(values: Floats) -> Floats:
        out = values[:count].copy()
        out[:, column] = values[samples:, column]
        return out

    shortened = {"stamp": series.stamp[:count], "log_time": series.log_time[:count]}
    moved = replace(series, **shortened, **_each(series, ahead))
    return replace(recorded, command=moved)


def drifting_clock(recorded: Recorded, drift: float) -> Recorded:
    """Let the clock of the states run fast by ``drift``: measured(t) = state(t (1 - drift)).

    t is counted from the recording's first stamp.
    """
    series = recorded.state
    start = min(int(series.stamp[0]), int(recorded.command.stamp[0]))
    late = np.round((series.stamp - start) * (drift / (1.0 - drift))).astype(np.int64)
    moved = replace(series, stamp=series.stamp + late, log_time=series.log_time + late)
    return replace(recorded, state=moved)


def scaled_encoder(recorded: Recorded, joint: str, error: float) -> Recorded:
    """Scale readings: measured = (1 + error) q, with the same factor on velocity."""
    return _read(recorded, joint, lambda q: (1.0 + error) * q, lambda q, v: (1.0 + error) * v)


def biased_encoder(recorded: Recorded, joint: str, bias: float) -> Recorded:
    """Add a bias: measured = q + bias; the velocity is unchanged."""
    return _read(recorded, joint, lambda q: q + bias, lambda q, v: v)


def bent_encoder(recorded: Recorded, joint: str, amplitude: float, phase: float) -> Recorded:
    """Add an eccentricity: measured = q + amplitude sin(q + phase), velocity likewise."""
    return _read(
        recorded, joint,
        lambda q: q + amplitude * np.sin(q + phase),
        lambda q, v: v * (1.0 + amplitude * np.cos(q + phase)),
    )  # fmt: skip


def quantized_encoder(recorded: Recorded, joint: str, step: float) -> Recorded:
    """Quantize positions to multiples of ``step`` rad or m; the velocity is unchanged."""
    return _read(recorded, joint, lambda q: step * np.round(q / step), lambda q, v: v)


def dropped_states(recorded: Recorded, share: float, rng: np.random.Generator) -> Recorded:
    """Remove a ``share`` of the states, except the first and the last."""
    series = recorded.state
    kept = rng.random(len(series.stamp)) >= share
    kept[[0, -1]] = True
    return replace(recorded, state=_rows(series, kept))


def filtered_velocity(recorded: Recorded, joint: str, time_constant: float) -> Recorded:
    """Low-pass the velocity: time_constant dw/dt = v - w, initially w = v.

    This is exact if v is constant between samples, as in a driver.
    """
    series = recorded.state
    if series.velocity is None:
        raise ValueError("no velocity to filter")
    column = series.names.index(joint)
    velocity = series.velocity.copy()
    share = -np.expm1(-np.diff(series.stamp) * 1e-9 / time_constant)
    for k, part in enumerate(share, start=1):
        velocity[k, column] = part * velocity[k, column] + (1.0 - part) * velocity[k - 1, column]
    return replace(recorded, state=replace(series, velocity=velocity))


def echoed_effort(recorded: Recorded) -> Recorded:
    """Replace efforts by the latest command, like a drive without an effort sensor."""
    series, command = recorded.state, recorded.command
    if command.effort is None:
        raise ValueError("no commanded effort to echo")
    latest = np.clip(np.searchsorted(command.stamp, series.stamp, side="right") - 1, 0, None)
    columns = [command.names.index(name) for name in series.names]
    return replace(recorded, state=replace(series, effort=command.effort[latest][:, columns]))


def misread_effort(recorded: Recorded, joint: str, error: float, bias: float) -> Recorded:
    """Scale and shift efforts: measured = (1 + error) effort + bias."""
    series = recorded.state
    if series.effort is None:
        raise ValueError("no effort to misread")
    effort = series.effort.copy()
    column = series.names.index(joint)
    effort[:, column] = (1.0 + error) * effort[:, column] + bias
    return replace(recorded, state=replace(series, effort=effort))


def cut(recorded: Recorded, start: float, seconds: float) -> Recorded:
    """Return the segment of ``seconds`` that begins ``start`` s after the first state."""
    first = int(recorded.state.stamp[0]) + round(start * 1e9)
    last = first + round(seconds * 1e9)

    def inside(series: JointSeries) -> JointSeries:
        return _rows(series, (series.stamp >= first) & (series.stamp < last))

    return replace(recorded, state=inside(recorded.state), command=inside(recorded.command))


def of_joints(recorded: Recorded, joints: tuple[str, ...]) -> Recorded:
    """Return the recording with the columns of the given joints only, in their order."""

    def chosen(series: JointSeries) -> JointSeries:
        columns = [series.names.index(joint) for joint in joints]
        return replace(series, names=joints, **_each(series, lambda values: values[:, columns]))

    return replace(recorded, state=chosen(recorded.state), command=chosen(recorded.command))


def _each(series: JointSeries, change: Callable[[Floats], Floats]) -> dict[str, Floats]:
    """Apply a change to the quantities that a series has."""
    values = {name: getattr(series, name) for name in ("position", "velocity", "effort")}
    return {name: change(table) for name, table in values.items() if table is not None}


def _rows(series: JointSeries, rows: Rows) -> JointSeries:
    """Return the series with the given messages only."""
    return replace(
        series, stamp=series.stamp[rows], log_time=series.log_time[rows],
        **_each(series, lambda values: values[rows]),
    )  # fmt: skip


def _moved(series: JointSeries, seconds: float) -> JointSeries:
    """Return the series with stamps ``seconds`` later."""
    late = round(seconds * 1e9)
    return replace(series, stamp=series.stamp + late, log_time=series.log_time + late)


def _read(
    recorded: Recorded,
    joint: str,
    position: Callable[[Floats], Floats],
    velocity: Callable[[Floats, Floats], Floats],
) -> Recorded:
    """Change one joint's readings by functions of q, and of q and v."""
    series = recorded.state
    if series.position is None:
        raise ValueError("no position to misread")
    column = series.names.index(joint)
    q = series.position[:, column]
    changed = {"position": series.position.copy()}
    changed["position"][:, column] = position(q)
    if series.velocity is not None:
        changed["velocity"] = series.velocity.copy()
        changed["velocity"][:, column] = velocity(q, series.velocity[:, column])
    return replace(recorded, state=replace(series, **changed))
