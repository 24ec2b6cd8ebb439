"""Dated sessions of one robot, and the refusal of recordings that have no place among them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from pytest_twin.diagnosis.temperature import TEMPERATURE_KEY, parse_temperatures
from pytest_twin.errors import RecordingError
from pytest_twin.identification.effort.amounts import without_amounts
from pytest_twin.identification.measured_recordings import MeasuredRecording, read_measured
from pytest_twin.identification.roles import NO_PAYLOAD, reduce_to_common_joints
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.time_limit import skips
from pytest_twin.trial.repeated_motion import without_repeated

DATE_KEY = "date"
ROBOT_KEYS = ("robot", "robot_id", "serial", "serial_number")
"""Metadata that say which robot was recorded."""
DECLARED_KEYS = ("controller", "tool", "payload")
"""Metadata whose changes are declared differences of the robot, and no change of its wear."""
FEWEST_SESSIONS = 4
"""Fewest sessions among which a change can be distinguished from their scatter: with three, one
degree of freedom would be left."""
_FIRST_EPOCH = int(datetime(2000, 1, 1, tzinfo=UTC).timestamp() * 1e9)
"""Stamp, ns, below which a clock counts from its start instead of from 1970."""
_PAUSE = timedelta(hours=2)
"""Pause after which a new session begins. Recordings within one share temperature and set-up, so
that they are no independent repetitions."""
_OTHER_ZONE = timedelta(hours=14)
"""Largest offset of a time zone: the uncertainty of a time without one."""
_DAY = 10
"""Number of characters of a date without a time: 2026-05-03."""
_CONFLICT = timedelta(hours=48)
"""Difference of a stamp and a stated date that no time zone and no date without time explains."""


@dataclass(frozen=True)
class Session:
    """Recordings of one robot without a long pause between them.

    Attributes:
        date: time of the first recording, UTC.
        recordings: stretches without gaps, in the order of time.
        temperature: as stated, degC or K; None if not every recording states a number.
        declared: metadata that are declared differences -> their value; empty where not stated.
    """

    date: datetime
    recordings: tuple[MeasuredRecording, ...]
    temperature: float | None
    declared: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """Names of its files."""
        return list(dict.fromkeys(one.path.name for one in self.recordings))


def read_sessions(
    realization: Realization,
    paths: Sequence[Path],
    topics: Mapping[str, str],
    options: RecordingOptions,
) -> tuple[list[Session], list[str]]:
    """Read recordings, order them by date, and join those of one session.

    Returns:
        The sessions by date, and notes.

    Raises:
        RecordingError: a recording has no date or no effort, another robot or an unknown payload,
            or there are too few sessions.
        TwinError: a recording cannot be read.
    """
    notes: list[str] = []
    read: list[MeasuredRecording] = []
    for path in dict.fromkeys(paths):
        if skips(path.name):
            continue
        read += read_measured(path, realization, topics, options, options.signals)
    read, _ = without_repeated(read, [], notes)
    if not read:
        raise RecordingError(
            "the time was over before a recording was read", path=paths[0],
            expected="a larger --seconds (0: no limit)",
        )  # fmt: skip
    for one in read:
        _refuse_unusable(one)
    _refuse_other_robot(read)
    _refuse_unknown_payloads(read, realization)
    dates = [date_of(one) for one in read]
    notes += _notes_on_zones(read)
    common = without_amounts(realization, reduce_to_common_joints(read, [], notes))
    joined = common.fit
    notes += list(dict.fromkeys(note for one in joined for note in one.notes))
    order = sorted(range(len(joined)), key=lambda i: (dates[i], joined[i].start))
    if any(dates[i] > dates[i + 1] for i in range(len(dates) - 1)):
        notes.append("the recordings are ordered by their dates, which differ from the given order")
    temperatures = parse_temperatures(
        sorted({one.metadata[TEMPERATURE_KEY] for one in joined if TEMPERATURE_KEY in one.metadata})
    )
    sessions: list[list[int]] = []
    for i in order:
        if not sessions or dates[i] - dates[sessions[-1][-1]] > _PAUSE:
            sessions.append([])
        sessions[-1].append(i)
    found = [
        Session(
            dates[which[0]],
            tuple(joined[i] for i in which),
            _temperature([joined[i] for i in which], temperatures or {}),
            _declared([joined[i] for i in which]),
        )
        for which in sessions
    ]
    if len(found) < FEWEST_SESSIONS:
        raise RecordingError(
            f"too few sessions: a session ends with a pause of {_PAUSE.seconds // 3600} h",
            path=joined[0].path,
            value=len(found),
            expected=f"recordings of at least {FEWEST_SESSIONS} sessions; two are compared by "
            "pytest-twin diagnose MODEL NEW --before OLD",
        )
    return found, notes


def date_of(one: MeasuredRecording) -> datetime:
    """Date of a recording, UTC: its epoch stamps, else ``date`` in the metadata of the trial.

    A time without a zone is taken as UTC.

    Raises:
        RecordingError: it has neither, the date cannot be read, lies in the future, or contradicts
            the stamps.
    """
    stated = _stated_date(one)
    now = datetime.now(UTC)
    if one.stamp >= _FIRST_EPOCH:
        date = datetime.fromtimestamp(one.stamp * 1e-9, UTC)
        if stated is not None and abs(date - stated) > _CONFLICT:
            raise _refused(
                one, "its stamps and its date contradict each other",
                f"{date:%Y-%m-%d} and {stated:%Y-%m-%d}", "the same day in both",
            )  # fmt: skip
    elif stated is None:
        raise _refused(
            one, "no date: its clock counts from its own start", one.metadata.get(DATE_KEY, "none"),
            "stamps since 1970, or date: 2026-05-03 in the metadata of the trial",
        )  # fmt: skip
    else:
        date = stated
    if date > now + _OTHER_ZONE:
        raise _refused(one, "a date in the future", f"{date:%Y-%m-%d}", f"before {now:%Y-%m-%d}")
    return date


def _stated_date(one: MeasuredRecording) -> datetime | None:
    text = one.metadata.get(DATE_KEY, "").strip()
    if not text:
        return None
    try:
        date = datetime.fromisoformat(text)
    except ValueError:
        raise _refused(
            one, "not a date", text, "2026-05-03 or 2026-05-03T14:30:00+02:00 (ISO 8601)"
        ) from None
    return date.replace(tzinfo=UTC) if date.tzinfo is None else date.astimezone(UTC)


def _refused(one: MeasuredRecording, problem: str, value: str, expected: str) -> RecordingError:
    return RecordingError(
        problem, path=one.path, where="metadata 'trial': date", value=value, expected=expected
    )


def _notes_on_zones(read: Sequence[MeasuredRecording]) -> list[str]:
    """Whether times without a zone leave the order of sessions open."""
    stated = [one.metadata[DATE_KEY].strip() for one in read if one.stamp < _FIRST_EPOCH]
    times = [text for text in stated if len(text) > _DAY]
    without = [text for text in times if datetime.fromisoformat(text).tzinfo is None]
    if not without:
        return []
    return [
        f"dates without a time zone are taken as UTC, in {len(without)} recordings: sessions less "
        f"than {_OTHER_ZONE.total_seconds() / 3600:.0f} h apart may have another order"
    ]


def _refuse_unusable(one: MeasuredRecording) -> None:
    if one.base is not None:
        raise RecordingError(
            "the base of the robot moves; trend follows robots with a fixed base", path=one.path,
            where="pose of the base", expected="recordings of a robot whose base is fixed",
        )  # fmt: skip
    if not np.isfinite(one.effort).any():
        raise RecordingError(
            "no measured effort, by which parameters are followed", path=one.path, where="effort",
            expected="efforts or currents of the joints; positions alone are compared by "
            "pytest-twin diagnose MODEL NEW --before OLD",
        )  # fmt: skip


def _refuse_other_robot(read: Sequence[MeasuredRecording]) -> None:
    for key in ROBOT_KEYS:
        stated = {one.metadata[key]: one for one in read if key in one.metadata}
        if len(stated) > 1:
            first, second = list(stated)[:2]
            raise RecordingError(
                "another robot than in the other recordings", path=stated[second].path,
                where=f"metadata 'trial': {key}", value=second,
                expected=f"{first}; follow several robots with --fleet",
            )  # fmt: skip


def _refuse_unknown_payloads(read: Sequence[MeasuredRecording], realization: Realization) -> None:
    """Refuse payloads that differ and whose mass the twin does not state."""
    known = () if realization.twin is None else realization.twin.payloads
    unknown = {
        "" if payload.lower() in NO_PAYLOAD or payload in known else payload: one
        for one in read
        for payload in [one.metadata.get("payload", "")]
    }
    if len(unknown) > 1:
        payload, one = next(item for item in unknown.items() if item[0])
        raise RecordingError(
            "its payload differs from that of other recordings, and its mass is not declared",
            path=one.path, where="metadata 'trial': payload", value=payload,
            expected="payloads: in twin.yaml with the mass of every payload",
        )  # fmt: skip


def _temperature(
    recordings: Sequence[MeasuredRecording], known: Mapping[str, float]
) -> float | None:
    stated = [one.metadata.get(TEMPERATURE_KEY, "") for one in recordings]
    if not all(text in known for text in stated):
        return None
    return float(np.mean([known[text] for text in stated]))


def _declared(recordings: Sequence[MeasuredRecording]) -> dict[str, str]:
    declared = {}
    for key in DECLARED_KEYS:
        values = sorted({one.metadata[key] for one in recordings if key in one.metadata})
        if values:
            declared[key] = " and ".join(values)
    return declared
