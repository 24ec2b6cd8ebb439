"""Follow one robot over its sessions: parameters, errors, changes and alarms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.loaded_model import load_model
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.time_limit import limited
from pytest_twin.trend.change_points import (
    Alarm,
    ChangePoint,
    changes_of,
    declared_steps,
    detectable,
    switches_between_levels,
)
from pytest_twin.trend.parameters import Estimates, Followed, estimate
from pytest_twin.trend.sessions import DECLARED_KEYS, FEWEST_SESSIONS, Session, read_sessions
from pytest_twin.trend.tails import tails_of
from pytest_twin.twin import DeclaredEvent

_FEWEST_SWITCHES = 3
"""Switches between two levels from which they are no change and its repair."""
_WARMS_UP = 3.0
"""Mean of the drift within sessions, in its standard errors, above which sessions warm up."""
UNEXPLAINED = "unexplained_effort"
"""Name of the error that no followed parameter explains."""


@dataclass(frozen=True)
class Change:
    """A change of one series.

    Attributes:
        followed: the parameter; its kind is ``UNEXPLAINED`` for the error of a joint.
        point: kind, place, size and probability.
        which: (n,) indices of the sessions of the series.
    """

    followed: Followed
    point: ChangePoint
    which: NDArray[np.intp]


@dataclass(frozen=True)
class Trend:
    """One robot over its sessions.

    Attributes:
        sessions: by date.
        estimates: parameters and errors of every session.
        changes: clearest first; every one is an alarm.
        detectable: (p,) smallest step in the middle of the history that is found every second time.
        mixed: parameters that switch between two levels -> number of switches.
        warm_up: (p,) change within a session while it warms up; 0 where temperatures are known.
        events: declared events.
        declared: what is declared and taken out, one line each.
        notes: one line each.
    """

    sessions: tuple[Session, ...]
    estimates: Estimates
    changes: tuple[Change, ...]
    detectable: FloatArray
    mixed: Mapping[str, int]
    warm_up: FloatArray
    events: tuple[DeclaredEvent, ...]
    declared: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def is_alarm(self) -> bool:
        """Whether something changed."""
        return bool(self.changes or self.mixed)


@dataclass(frozen=True, slots=True)
class TrendRequest:
    """Request of a trend, as passed between processes.

    Attributes:
        recordings: files and folders.
        level: probability of an alarm if nothing changed.
        seconds: limit of the processor time, s; 0 for none.
    """

    model: str
    recordings: Sequence[str]
    topics: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    level: float = 0.05
    seconds: float = 0.0


def follow_files(
    request: Mapping[str, Any], progress: Callable[[float], None] = lambda fraction: None
) -> dict[str, Any]:
    """Load, follow, and return the content of ``trend.json``; runs in the child process.

    Args:
        request: fields of :class:`TrendRequest`.
        progress: called with the fraction done.

    Raises:
        TwinError: the input cannot be used.
    """
    from pytest_twin.trend.document import trend_document

    asked = TrendRequest(**request)
    options = RecordingOptions.from_json(asked.options)
    with limited(asked.seconds) as limit:
        loaded = load_model(Path(asked.model), options.base)
        sessions, notes = read_sessions(
            loaded.realization, [Path(path) for path in asked.recordings],
            {**loaded.topics, **asked.topics}, options.over(loaded.options),
        )  # fmt: skip
        progress(0.5)
        followed = follow(loaded.realization, sessions, asked.level, notes)
    progress(0.95)
    return {
        **trend_document(followed, asked.level),
        "not_tried": limit.not_tried,
        "ended_early": limit.note("These recordings are left out"),
    }


def follow(
    realization: Realization, sessions: Sequence[Session], level: float, notes: Sequence[str] = ()
) -> Trend:
    """Estimate the parameters of every session, and find what changed.

    Args:
        level: probability of an alarm if nothing changed, such as 0.05.
    """
    estimates = estimate(realization, [one.recordings for one in sessions])
    events = () if realization.twin is None else realization.twin.events
    date = np.array([one.date.timestamp() for one in sessions])
    declared, lines, more = _declared(sessions, events, date)
    has_temperature = any("temperature" in line for line in lines)
    warm_up = np.zeros(len(estimates.followed)) if has_temperature else _warm_up(estimates.drift)
    series = [
        (one, estimates.value[:, k], estimates.std[:, k], float(warm_up[k]))
        for k, one in enumerate(estimates.followed)
    ]
    for j, joint in enumerate(estimates.joints):
        error = np.log(np.maximum(estimates.unexplained[:, j], 1e-12))
        whole = Followed(joint, UNEXPLAINED, "1", "effort that no followed parameter explains")
        series.append((whole, error, np.zeros(len(error)), 0.0))
    usable = [np.flatnonzero(np.isfinite(value)) for _, value, _, _ in series]
    count = sum(len(which) >= FEWEST_SESSIONS for which in usable)
    tails = tails_of([
        _without(value[which], declared[which])
        for (_, value, _, _), which in zip(series, usable, strict=True)
    ])  # fmt: skip
    alarm = Alarm(level, count, tails)
    changes, mixed, smallest = [], {}, np.full(len(estimates.followed), np.inf)
    for k, ((followed, value, std, tolerated), which) in enumerate(
        zip(series, usable, strict=True)
    ):
        if len(which) < FEWEST_SESSIONS:
            continue
        own, known = value[which], declared[which]
        found = changes_of(own, std[which], date[which], known, alarm, tolerated)
        changes += [Change(followed, point, which) for point in found]
        if k < len(smallest):
            smallest[k] = detectable(own, std[which], known, alarm) + tolerated
            switches = switches_between_levels(_without(own, known))
            if switches >= _FEWEST_SWITCHES:
                mixed[followed.name] = switches
    changes.sort(key=lambda one: (one.point.probability, -abs(one.point.size / one.point.std)))
    if warm_up.any():
        more.append(
            "no temperatures are recorded, and parameters change within sessions: a change of the "
            "size of this warm-up is no alarm; state temperature: in the metadata of the trials"
        )
    return Trend(
        tuple(sessions), estimates, tuple(changes), smallest, mixed, warm_up, events, tuple(lines),
        (*notes, *more),
    )  # fmt: skip


def _declared(
    sessions: Sequence[Session], events: Sequence[DeclaredEvent], date: FloatArray
) -> tuple[FloatArray, list[str], list[str]]:
    """(sessions, q) declared differences, a line for each, and notes on those that do not count."""
    columns, lines, notes = [], [], []
    temperatures = [one.temperature for one in sessions]
    known = [t for t in temperatures if t is not None]
    if len(known) == len(sessions) and len(set(known)) > 1:
        column = np.array(known)
        columns.append(column - column.mean())
        lines.append(f"temperature: {min(known):g} to {max(known):g}")
    elif known and len(known) < len(sessions):
        notes.append(
            f"temperature is stated for {len(known)} of {len(sessions)} sessions, so it is not used"
        )
    for key in DECLARED_KEYS:
        values = [one.declared.get(key, "") for one in sessions]
        for value in sorted(set(values))[1:]:
            columns.append(np.array([float(own == value) for own in values]))
            lines.append(f"{key}: {value or 'not stated'}")
    steps = declared_steps([event.date.timestamp() for event in events], date)
    for event in events:
        inside = date[0] < event.date.timestamp() <= date[-1]
        text = f"{event.date:%Y-%m-%d}: {event.what}"
        (lines if inside else notes).append(text if inside else f"outside the recordings: {text}")
    every = np.column_stack([*columns, steps]) if columns else steps
    return every, lines, notes


def _warm_up(drift: FloatArray) -> FloatArray:
    """(p,) change from the coldest to the warmest part of a session, where it is systematic."""
    sizes = np.zeros(drift.shape[1])
    for k, own in enumerate(drift.T):
        known = own[np.isfinite(own)]
        if len(known) < FEWEST_SESSIONS:
            continue
        error = float(known.std(ddof=1)) / np.sqrt(len(known))
        if abs(float(known.mean())) > _WARMS_UP * error:
            # Between the means of both halves lies half of the warm-up.
            sizes[k] = 2.0 * abs(float(known.mean()))
    return sizes


def _without(value: FloatArray, declared: FloatArray) -> FloatArray:
    """The series without what is declared."""
    if not declared.shape[1]:
        return value
    columns = declared - declared.mean(axis=0)
    left: FloatArray = value - columns @ np.linalg.lstsq(columns, value, rcond=None)[0]
    return left
