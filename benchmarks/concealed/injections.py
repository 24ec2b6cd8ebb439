"""What is concealed in a recording: exact changes of stamps and readings, as pure functions.

A recording of a real machine in, the recording that a machine with one more flaw would have left
out. Nothing is simulated, so noise and everything that nobody modelled stay real. Each docstring
states the equation that holds exactly between the old and the new values.

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
        metadata: of the trial: role, controller, ...
    """

    state: JointSeries
    command: JointSeries
    metadata: dict[str, str]


def late_states(recorded: Recorded, seconds: float) -> Recorded:
    """Each state is stamped ``seconds`` late: measured(t) = state(t - seconds)."""
    return replace(recorded, state=_moved(recorded.state, seconds))


def late_drive(recorded: Recorded, seconds: float) -> Recorded:
    """Each command is stamped ``seconds`` early: the drive acts on command(t - seconds)."""
    return replace(recorded, command=_moved(recorded.command, -seconds))


def late_drive_of(recorded: Recorded, joint: str, samples: int) -> Recorded:
    """One joint's commands are those of ``samples`` messages later: that drive alone acts late.

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
    """The clock of the states runs fast by ``drift``: measured(t) = state(t (1 - drift)).

    t is counted from the recording's first stamp.
    """
    series = recorded.state
    start = min(int(series.stamp[0]), int(recorded.command.stamp[0]))
    late = np.round((series.stamp - start) * (drift / (1.0 - drift))).astype(np.int64)
    moved = replace(series, stamp=series.stamp + late, log_time=series.log_time + late)
    return replace(recorded, state=moved)


def scaled_encoder(recorded: Recorded, joint: str, error: float) -> Recorded:
    """measured = (1 + error) q, and the same factor on velocity."""
    return _read(recorded, joint, lambda q: (1.0 + error) * q, lambda q, v: (1.0 + error) * v)


def biased_encoder(recorded: Recorded, joint: str, bias: float) -> Recorded:
    """measured = q + bias; velocity as it was."""
    return _read(recorded, joint, lambda q: q + bias, lambda q, v: v)


def bent_encoder(recorded: Recorded, joint: str, amplitude: float, phase: float) -> Recorded:
    """measured = q + amplitude sin(q + phase), velocity times the slope of that."""
    return _read(
        recorded, joint,
        lambda q: q + amplitude * np.sin(q + phase),
        lambda q, v: v * (1.0 + amplitude * np.cos(q + phase)),
    )  # fmt: skip


def quantized_encoder(recorded: Recorded, joint: str, step: float) -> Recorded:
    """measured = the nearest multiple of ``step`` rad or m; velocity as it was."""
    return _read(recorded, joint, lambda q: step * np.round(q / step), lambda q, v: v)


def dropped_states(recorded: Recorded, share: float, rng: np.random.Generator) -> Recorded:
    """A ``share`` of the states never arrived; the first and the last did."""
    series = recorded.state
    kept = rng.random(len(series.stamp)) >= share
    kept[[0, -1]] = True
    return replace(recorded, state=_rows(series, kept))


def filtered_velocity(recorded: Recorded, joint: str, time_constant: float) -> Recorded:
    """The driver low-passes velocity: time_constant dw/dt = v - w, w = v at first.

    Exact where v is constant between samples, as a driver computes it.
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
    """The states carry the latest commanded effort, as a drive without a sensor reports it."""
    series, command = recorded.state, recorded.command
    if command.effort is None:
        raise ValueError("no commanded effort to echo")
    latest = np.clip(np.searchsorted(command.stamp, series.stamp, side="right") - 1, 0, None)
    columns = [command.names.index(name) for name in series.names]
    return replace(recorded, state=replace(series, effort=command.effort[latest][:, columns]))


def misread_effort(recorded: Recorded, joint: str, error: float, bias: float) -> Recorded:
    """measured effort = (1 + error) effort + bias."""
    series = recorded.state
    if series.effort is None:
        raise ValueError("no effort to misread")
    effort = series.effort.copy()
    column = series.names.index(joint)
    effort[:, column] = (1.0 + error) * effort[:, column] + bias
    return replace(recorded, state=replace(series, effort=effort))


def cut(recorded: Recorded, start: float, seconds: float) -> Recorded:
    """The stretch of ``seconds`` that begins ``start`` s after the first state."""
    first = int(recorded.state.stamp[0]) + round(start * 1e9)
    last = first + round(seconds * 1e9)

    def inside(series: JointSeries) -> JointSeries:
        return _rows(series, (series.stamp >= first) & (series.stamp < last))

    return replace(recorded, state=inside(recorded.state), command=inside(recorded.command))


def of_joints(recorded: Recorded, joints: tuple[str, ...]) -> Recorded:
    """The same with the columns of some joints alone, in their order."""

    def chosen(series: JointSeries) -> JointSeries:
        columns = [series.names.index(joint) for joint in joints]
        return replace(series, names=joints, **_each(series, lambda values: values[:, columns]))

    return replace(recorded, state=chosen(recorded.state), command=chosen(recorded.command))


def _each(series: JointSeries, change: Callable[[Floats], Floats]) -> dict[str, Floats]:
    """The quantities that a series has, changed."""
    values = {name: getattr(series, name) for name in ("position", "velocity", "effort")}
    return {name: change(table) for name, table in values.items() if table is not None}


def _rows(series: JointSeries, rows: Rows) -> JointSeries:
    """The same with some messages alone."""
    return replace(
        series, stamp=series.stamp[rows], log_time=series.log_time[rows],
        **_each(series, lambda values: values[rows]),
    )  # fmt: skip


def _moved(series: JointSeries, seconds: float) -> JointSeries:
    """The same, stamped ``seconds`` later."""
    late = round(seconds * 1e9)
    return replace(series, stamp=series.stamp + late, log_time=series.log_time + late)


def _read(
    recorded: Recorded,
    joint: str,
    position: Callable[[Floats], Floats],
    velocity: Callable[[Floats, Floats], Floats],
) -> Recorded:
    """The same with another reading of one joint: of q, and of q and v."""
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
