"""Choose one clock for states and commands: header stamps or log times of the recorder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import RecordingError
from pytest_twin.formats.recording import JointSeries
from pytest_twin.recording_options import Clock

Stamps = NDArray[np.int64]

LATCHED_SECONDS = 1.0
"""s. A command up to this long before the first state is used, such as a latched one."""
# Median intervals. Stamps that go back further and stay back are a step of the clock; messages in
# another order go back by one or two intervals.
_STEP_INTERVALS = 4.0
# Number of messages on either side of a step over which the offset of the clock is compared.
_MESSAGES_AROUND_STEP = 20
# Log times are usable if their median interval equals that of the stamps within this factor.
_LOG_RATE = 2.0
# Log times are converted if the rate of the two clocks differs by more than this fraction.
_SAME_RATE = 0.01
_MAX_STEPS = 1000
# Fewer messages than this do not determine a rate.
_MIN_MESSAGES = 20
# s. Difference of the usual delays from stamp to recorder beyond which two topics have two clocks:
# a network delivers joint states within some ms.
_SAME_DELAY = 0.05
# Scatter of these delays, relative to their difference, up to which the difference is constant.
_STEADY_DELAY = 0.25
_NS = 1e-9
"""Seconds in a nanosecond."""


@dataclass(frozen=True, slots=True)
class TimedMessages:
    """Messages of one topic with the chosen times.

    Attributes:
        stamp: (n,) ns, in the order of the file.
        rows: (n,) indices of the messages in the series.
    """

    series: JointSeries
    stamp: Stamps
    rows: NDArray[np.int64]

    def part(self, first: int, end: int) -> TimedMessages:
        """Messages from ``first`` to before ``end``."""
        return TimedMessages(self.series, self.stamp[first:end], self.rows[first:end])


@dataclass(frozen=True, slots=True)
class TopicsOnOneClock:
    """States and commands on one clock.

    Attributes:
        pieces: (states, commands) between steps of the clock; one piece without a step.
        notes: decisions, one line each.
    """

    pieces: tuple[tuple[TimedMessages, TimedMessages], ...]
    notes: tuple[str, ...]


def on_one_clock(
    states: JointSeries, commands: JointSeries, asked: Clock | None, path: Path
) -> TopicsOnOneClock:
    """Choose the times of two topics.

    Header stamps are used if both topics have them and they overlap. Log times are used if one
    topic has no stamps, if only log times overlap, or if the clock of the stamps steps and log
    times do not. Without usable log times the recording is split at a step.

    Args:
        asked: the clock that a user chose, or None.
        path: path of the recording, for errors.

    Raises:
        RecordingError: the topics do not overlap on any clock; stamps were chosen and there are
            none; a clock steps in one topic only.
    """
    topics = (states, commands)
    unset = [_lacks_stamp(one) for one in topics]
    if asked == "log":
        return _by_log(topics, ["log times are used for both topics, as asked"])
    if asked == "stamp":
        for one, none in zip(topics, unset, strict=True):
            if none.all():
                raise RecordingError(
                    "no message has a stamp", path=path, where=one.topic, value="header.stamp 0",
                    expected="stamps, or --clock log",
                )  # fmt: skip
    else:
        few = [2 * none.sum() > len(none) for none in unset]
        if all(few):
            return _by_log(topics, ["no message has a stamp: log times are used"])
        for one, bare in zip(topics, few, strict=True):
            if bare:
                return _without_stamps(topics, unset, one)
    notes = []
    timed = []
    for one, none in zip(topics, unset, strict=True):
        rows = np.flatnonzero(~none)
        if none.any():
            notes.append(
                f"{one.topic}: {int(none.sum())} of {len(none)} messages are left out, they have "
                "no stamp (header.stamp is 0)"
            )
        timed.append(TimedMessages(one, one.stamp[rows], rows))
    overlap, logs = _overlaps(*(t.stamp for t in timed)), _has_log_times(topics)
    log_overlap = _overlaps(*(one.log_time for one in topics))
    if not overlap:
        if asked is None and log_overlap and logs:
            for one in topics:
                if _is_log(one):
                    return _without_stamps(topics, unset, one)
            return _by_log(
                topics,
                ["stamps of states and commands do not overlap, log times do: log times are used "
                 "for both topics (--clock stamp to refuse)"],
            )  # fmt: skip
        raise _no_overlap(timed, path, log_overlap)
    return _stepping(timed, notes, asked is None and logs and log_overlap, path)


def _lacks_stamp(series: JointSeries) -> NDArray[np.bool_]:
    """(n,) which messages have no stamp; the time of a simulation may begin with one stamp 0."""
    if not series.stamped:
        return np.ones(len(series.stamp), dtype=bool)
    none: NDArray[np.bool_] = series.stamp == 0
    if _is_log(series):
        # A format with one time for each row has no stamp that may be missing.
        return np.zeros_like(none)
    if none.sum() == 1 and none[0] and len(none) > 2:
        usual = float(np.median(np.diff(series.stamp[1:])))
        if series.stamp[1] <= _STEP_INTERVALS * max(usual, 1.0):
            none = np.zeros_like(none)
    return none


def _is_log(series: JointSeries) -> bool:
    """Whether the reader used log times as stamps, because the messages have none."""
    return bool((series.stamp == series.log_time).all())


def _without_stamps(
    topics: tuple[JointSeries, JointSeries], unset: list[NDArray[np.bool_]], bare: JointSeries
) -> TopicsOnOneClock:
    other, its_unset = (topics[1], unset[1]) if bare is topics[0] else (topics[0], unset[0])
    if not bare.stamped or (bare.stamp == 0).all():
        said = f"{bare.topic}: no message has a stamp"
    elif _is_log(bare):
        said = f"{bare.topic} has log times alone and {other.topic} stamps of another clock"
    else:
        said = f"{bare.topic}: few messages have a stamp"
    rate = None if its_unset.any() else _rate(other)
    if rate is not None:
        slope, offset = rate
        stamp = np.rint(offset + slope * (bare.log_time - other.log_time[0])).astype(np.int64)
        bare_timed = TimedMessages(bare, stamp + other.stamp[0], np.arange(len(stamp)))
        other_timed = TimedMessages(other, other.stamp, np.arange(len(other.stamp)))
        pair = (bare_timed, other_timed) if bare is topics[0] else (other_timed, bare_timed)
        return TopicsOnOneClock(
            (pair,),
            (
                f"{said}: its log times are put on the clock of {other.topic}, which runs at "
                f"{slope:.4g} times the recorder's",
            ),
        )
    return _by_log(
        topics, [f"{said}: log times are used for both topics (--clock stamp to refuse)"]
    )


def _rate(series: JointSeries) -> tuple[float, float] | None:
    """Rate of stamps relative to log times, and offset (ns); None where the rates are equal.

    They differ for a simulation that does not run in real time.
    """
    if len(series.stamp) < _MIN_MESSAGES:
        return None
    log = (series.log_time - series.log_time[0]).astype(np.float64)
    stamp = (series.stamp - series.stamp[0]).astype(np.float64)
    if log[-1] <= 0.0 or stamp[-1] <= 0.0:
        return None
    slope, offset = np.polyfit(log, stamp, 1)
    return (float(slope), float(offset)) if abs(slope - 1.0) > _SAME_RATE and slope > 0 else None


def _by_log(topics: tuple[JointSeries, JointSeries], notes: list[str]) -> TopicsOnOneClock:
    states, commands = (TimedMessages(t, t.log_time, np.arange(len(t.stamp))) for t in topics)
    return TopicsOnOneClock(((states, commands),), tuple(notes))


def _overlaps(states: Stamps, commands: Stamps) -> bool:
    latched = int(LATCHED_SECONDS / _NS)
    first, last = int(states.min()), int(states.max())
    if len(states) == 1:
        # With one state, the motion is predicted for all later commands.
        return bool(commands.max() >= first - latched)
    return bool(commands.min() <= last and commands.max() >= first - latched)


def _has_log_times(topics: tuple[JointSeries, JointSeries]) -> bool:
    """Whether log times are those of the recorder, and not of a later conversion of the file."""
    for one in topics:
        if len(one.stamp) < 3:
            continue
        if (np.diff(one.log_time) < 0).any():
            return False
        usual = np.median(np.abs(np.diff(one.stamp[one.stamp != 0]))) if one.stamp.any() else 0.0
        logged = np.median(np.diff(one.log_time))
        if logged <= 0 or not usual / _LOG_RATE <= logged <= max(usual, 1) * _LOG_RATE:
            return usual == 0.0
    return True


def _no_overlap(timed: list[TimedMessages], path: Path, log_overlap: bool) -> RecordingError:
    states, commands = timed
    start = int(states.stamp.min())
    first, last = ((int(t) - start) * _NS for t in (commands.stamp.min(), commands.stamp.max()))
    way = "--clock log takes the recorder's times" if log_overlap else "log times do not either"
    return RecordingError(
        "commands and states do not overlap in time",
        path=path,
        where=commands.series.topic,
        value=f"commands from {first:.6g} to {last:.6g} s, states from 0 to "
        f"{(int(states.stamp.max()) - start) * _NS:.6g}",
        unit="s",
        expected=f"one clock; {way}",
    )


def _stepping(
    timed: list[TimedMessages], notes: list[str], by_log: bool, path: Path
) -> TopicsOnOneClock:
    """Use log times, or split the recording, if the clock of the stamps steps."""
    states, commands = timed
    back = [_steps(t, backward=True) for t in timed]
    forward = [_steps(t, backward=False) if by_log else [] for t in timed]
    if not any(back) and not all(forward):
        if by_log:
            notes = notes + _two_clocks(states, commands)
        return TopicsOnOneClock(((states, commands),), tuple(notes))
    topic = states if back[0] or (not back[1] and forward[0]) else commands
    at = (back[0] or forward[0]) if topic is states else (back[1] or forward[1])
    jump = (int(topic.stamp[at[0]]) - int(topic.stamp[at[0] - 1])) * _NS
    count = max(len(a) + len(b) for a, b in zip(back, forward, strict=True))
    said = f"{topic.series.topic}: stamps step by {jump:.4g} s at message {int(topic.rows[at[0]])}"
    if count > 1:
        said += f", {count} such steps"
    if by_log:
        return _by_log(
            (states.series, commands.series),
            [f"{said}: log times, which go on, are used for both topics"],
        )
    if len(back[0]) != len(back[1]):
        raise RecordingError(
            "the clock of the stamps steps back in only one topic",
            path=path,
            where=topic.series.topic,
            value=f"{jump:.4g}",
            unit="s",
            expected="one clock in both topics, or --clock log",
        )
    bounds = [[0, *at, len(t.stamp)] for at, t in zip(back, timed, strict=True)]
    pieces = tuple(
        (
            states.part(bounds[0][i], bounds[0][i + 1]),
            commands.part(bounds[1][i], bounds[1][i + 1]),
        )
        for i in range(len(back[0]) + 1)
    )
    return TopicsOnOneClock(
        pieces, (*notes, f"{said} and log times do not help: the parts are apart")
    )


def _two_clocks(states: TimedMessages, commands: TimedMessages) -> list[str]:
    """A note if one topic is stamped late compared with the other, as the recorder saw them."""
    delays = [(t.series.log_time[t.rows] - t.stamp) * _NS for t in (states, commands)]
    usual = [float(np.median(delay)) for delay in delays]
    scatter = [float(np.median(np.abs(d - m))) for d, m in zip(delays, usual, strict=True)]
    ahead = usual[0] - usual[1]
    if min(map(len, delays)) < _MIN_MESSAGES or abs(ahead) < _SAME_DELAY:
        return []
    if max(scatter) > _STEADY_DELAY * abs(ahead):
        return []
    return [
        f"{commands.series.topic}: its stamps are {abs(ahead):.3g} s "
        f"{'later' if ahead > 0 else 'earlier'} than those of {states.series.topic}, compared with "
        "the recorder's times: two computers whose clocks differ, or a topic that arrives late; "
        "it looks like a delay of that size; --clock log takes the recorder's times"
    ]


def _steps(timed: TimedMessages, *, backward: bool) -> list[int]:
    """Indices of the messages before which the clock of the stamps stepped."""
    stamp, log = timed.stamp, timed.series.log_time[timed.rows]
    if len(stamp) < 3:
        return []
    step, logged = np.diff(stamp), np.diff(log)
    usual = float(np.median(np.abs(step)))
    bound = _STEP_INTERVALS * max(usual, 1.0)
    # A forward step is detected only in comparison with log times.
    jumps = step < -bound if backward else (step > bound) & (logged < 2.0 * np.median(logged))
    offset = stamp - (usual * np.arange(len(stamp)) if backward else log)
    found: list[int] = []
    # Larger numbers of steps are not evaluated, because such stamps are not a clock.
    for k in (np.flatnonzero(jumps)[:_MAX_STEPS] + 1).tolist():
        before, after = (
            offset[max(0, k - _MESSAGES_AROUND_STEP) : k],
            offset[k : k + _MESSAGES_AROUND_STEP],
        )
        moved = float(np.median(after)) - float(np.median(before))
        if abs(moved) >= 0.5 * abs(float(step[k - 1])) and (moved < 0) == backward:
            found.append(k)
    return found
