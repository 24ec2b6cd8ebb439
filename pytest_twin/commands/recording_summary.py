"""Summarize a recording for ``pytest-twin show``, as JSON data and as text."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.errors import TwinError
from pytest_twin.formats.recording import TOPICS, JointSeries, Recording, Topic
from pytest_twin.formats.recordings.candidates import describe, pairs, topics_option
from pytest_twin.formats.ros_serialization import QUANTITIES, Integers
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import make_trials
from pytest_twin.trial.marks import describe_marks, marks_to_json
from pytest_twin.trial.stream_checks import doubts
from pytest_twin.words import join_words

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

# Below this rate, Hz, a delay of a usual servo loop falls between two samples.
_SLOW = 50.0
# Motion of a joint, rad or m, below which friction and inertia cannot be determined.
_STILL = 0.02
# Log times that differ more from the stamps, s, are on another clock.
_OTHER_CLOCK = 1.0
# A gap is an interval more than this many times the usual one.
_GAP_INTERVALS = 4.0
# Stamps after this, ns, are absolute times: 2001-09-09.
_DATES_NS = 10**18
_PAIRS = 4
"""Largest number of proposed pairs of topics."""
_SAID_BEFORE = ("damage", "gap", "duplicate_stamp", "unordered_stamp")
"""Kinds of marks that the lines about the file and its series state."""


def survey(
    recording: Recording, options: RecordingOptions, realization: Realization | None = None
) -> dict[str, Any]:
    """Return the summary of a recording as JSON data.

    Args:
        options: options with which a command would read it.
        realization: the model; None without one.
    """
    from pytest_twin.replay_order import refuse_other_order

    structure = None if realization is None else realization.structure
    missing, advice = _missing_roles(recording), []
    usable, notes = None, list(recording.notes)
    if not missing:
        try:
            trials = make_trials(recording, structure, options)
            if realization is not None:
                refuse_other_order(realization, trials)
        except TwinError as error:
            missing.append(str(error))
        else:
            usable = {
                "trials": [
                    {"start": t.offset, "duration": t.duration, "unit": "s"} for t in trials
                ],
                "command_modes": dict(
                    zip(trials[0].command_joints, trials[0].command_modes, strict=True)
                ),
                "command_between": {
                    "value": trials[0].command_between,
                    "source": trials[0].between_source,
                },
                "base_moves": trials[0].base is not None,
                "marks": marks_to_json(trials),
            }
            notes = list(dict.fromkeys(note for trial in trials for note in trial.notes))
            advice = _advice(recording)
    if usable is None:
        notes += doubts(recording)
    return {
        "recording": str(recording.path),
        "topics": [_topic(topic, recording) for topic in recording.topics],
        "series": {role: _series(one) for role, one in recording.series.items()},
        "clock": _clock(recording),
        "trial": dict(recording.metadata),
        "damage": [str(item) for item in recording.damage],
        "notes": notes,
        "usable": usable,
        "missing": missing,
        "advice": advice,
    }


def _topic(topic: Topic, recording: Recording) -> dict[str, Any]:
    read_as = [role for role, one in recording.series.items() if one.topic == topic.name]
    return {
        "topic": topic.name,
        "type": topic.type,
        "messages": topic.messages,
        "joints": list(topic.joints),
        "fields": list(topic.filled),
        "read_as": read_as,
    }


def _series(one: JointSeries) -> dict[str, Any]:
    times = np.unique(one.stamp)
    steps = np.diff(times) * 1e-9
    usual = float(np.median(steps)) if len(steps) else None
    longest = int(np.argmax(steps)) if len(steps) else None
    gaps = [] if usual is None else np.flatnonzero(steps > _GAP_INTERVALS * usual).tolist()
    return {
        "topic": one.topic,
        "messages": len(one.stamp),
        "from_trajectories": one.from_trajectories,
        "joints": list(one.names),
        "fields": [name for name in QUANTITIES if getattr(one, name) is not None],
        "rate": {"value": None if not usual else 1.0 / usual, "unit": "Hz"},
        "longest_interval": None
        if longest is None
        else {"value": float(steps[longest]), "at": _since(times, longest), "unit": "s"},
        "gaps": [{"start": _since(times, at), "end": _since(times, at + 1)} for at in gaps],
        "range": _ranges(one),
    }


def _since(times: Integers, at: int) -> float:
    return float(times[at] - times[0]) * 1e-9


def _ranges(one: JointSeries) -> dict[str, dict[str, list[float]]]:
    """Return field -> joint -> [minimum, maximum]."""
    found: dict[str, dict[str, list[float]]] = {}
    for name in QUANTITIES:
        table = getattr(one, name)
        if table is None:
            continue
        found[name] = {
            joint: [float(seen.min()), float(seen.max())]
            for column, joint in enumerate(one.names)
            if (seen := table[np.isfinite(table[:, column]), column]).size
        }
    return found


def _clock(recording: Recording) -> dict[str, Any]:
    series = list(recording.series.values())
    if not series:
        return {}
    first = min(int(one.stamp.min()) for one in series)
    last = max(int(one.stamp.max()) for one in series)
    found: dict[str, Any] = {
        "first": first,
        "last": last,
        "unit": "ns",
        "duration": {"value": (last - first) * 1e-9, "unit": "s"},
        "log_after_stamp": {
            role: float(np.median(one.log_time - one.stamp)) * 1e-9
            for role, one in recording.series.items()
        },
    }
    if first > _DATES_NS:
        date = datetime.datetime.fromtimestamp(first // 10**9, datetime.UTC)
        found["date"] = date.strftime("%Y-%m-%d %H:%M:%S UTC")
    return found


def _missing_roles(recording: Recording) -> list[str]:
    absent = [role for role in TOPICS if role not in recording.series]
    if not absent:
        return []
    lacks = f"no {' and no '.join(f'{role}s' for role in absent)}"
    if not recording.topics:
        column = "NAME.command" if "command" in absent else "NAME.position"
        return [f"{lacks}: a CSV file has them in columns {column}"]
    options = [topics_option(*pair) for pair in pairs(recording)[:_PAIRS]]
    if options:
        return [f"{lacks} on the usual topics; try {' or '.join(options)}"]
    known = [describe(topic) for topic in recording.topics if topic.joints]
    if known:
        return [f"{lacks}, and no topic that could be; it has {'; '.join(known)}"]
    return [f"{lacks}: record them (ros2 bag record /joint_states and the controller's commands)"]


def _advice(recording: Recording) -> list[str]:
    """Return advice on data that would improve a diagnosis."""
    state, command = recording.series["state"], recording.series["command"]
    found = []
    rate = _series(state)["rate"]["value"]
    if rate is not None and rate < _SLOW:
        found.append(
            f"states at {rate:.3g} Hz: delays and lags below {500.0 / rate:.3g} ms cannot be "
            "resolved; record at 100 Hz or more"
        )
    if state.effort is None and command.effort is None:
        found.append(
            "no measured efforts: torque constant, payload and friction are harder to separate; "
            "record effort (or motor current) where the drive has it"
        )
    if "role" not in recording.metadata:
        found.append(
            "no role: give several recordings; whole ones are then held out, or name them with "
            "--held-out"
        )
    assert state.position is not None
    still = [
        joint
        for column, joint in enumerate(state.names)
        if joint in command.names
        and (seen := state.position[np.isfinite(state.position[:, column]), column]).size
        and float(np.ptp(seen)) < _STILL
    ]
    if still:
        found.append(
            f"moves less than {_STILL} rad or m: {', '.join(still)}; recordings show nothing "
            "about a joint that does not move"
        )
    return found


def in_words(
    kind: str, one: Mapping[str, Any], model: Path | None = None, options: str = ""
) -> list[str]:
    """Return the summary of one recording as lines of text.

    Args:
        one: result of :func:`survey`.
        model: MODEL of the command line.
        options: options of the command line that say how recordings are read.
    """
    clock = one["clock"]
    head = f"{one['recording']}: {kind}"
    if clock:
        head += f", {clock['duration']['value']:.4g} s"
        head += f" from {clock['date']}" if "date" in clock else ""
    lines = [head]
    if one["topics"]:
        width = max(len(topic["topic"]) for topic in one["topics"])
        lines.append("topics:")
        lines += [_topic_line(topic, width) for topic in one["topics"]]
    for role, series in one["series"].items():
        lines += _series_lines(role, series)
    lines += _clock_lines(clock)
    if one["trial"]:
        lines.append(
            "trial metadata: " + ", ".join(f"{key} {value}" for key, value in one["trial"].items())
        )
    lines += [f"damaged: {text}" for text in one["damage"]]
    lines += [f"note: {text}" for text in one["notes"]]
    lines += [f"missing: {text}" for text in one["missing"]]
    lines += [f"advice: {text}" for text in one["advice"]]
    usable = one["usable"]
    if usable is None:
        lines.append(
            f"A diagnosis of {model} cannot use this recording."
            if model is not None
            else "Without a model, its use cannot be told: a twin.yaml may name topics, joints and "
            f"columns (pytest-twin show MODEL {one['recording']}{options})"
        )
        return lines
    modes = sorted(set(usable["command_modes"].values()))
    between = usable["command_between"]
    parts = len(usable["trials"])
    in_parts = "" if parts == 1 else f", in {parts} parts between gaps"
    what = "replay" if usable["base_moves"] else "diagnosis"
    seconds = sum(trial["duration"] for trial in usable["trials"])
    lines += describe_marks(m for m in usable["marks"] if m["kind"] not in _SAID_BEFORE)
    lines.append(
        f"A {what} can use {seconds:.4g} s of it{in_parts}: "
        f"{join_words(modes)} commands of {', '.join(usable['command_modes'])}, "
        f"{between['value']} between stamps ({between['source']})."
    )
    ending = "--out predicted.mcap" if usable["base_moves"] else "... --out diagnosis"
    command = "replay" if usable["base_moves"] else "diagnose"
    lines.append(
        f"next: pytest-twin {command} {model or 'MODEL'} {one['recording']}{options} {ending}"
    )
    return lines


def _topic_line(topic: Mapping[str, Any], width: int) -> str:
    read = f"  <- {' and '.join(topic['read_as'])}" if topic["read_as"] else ""
    joints = f"  {', '.join(topic['joints'])}" if topic["joints"] else ""
    return (
        f"  {topic['topic']:<{width}}  {topic['messages']:>7}  {topic['type'] or '-'}{joints}{read}"
    )


def _series_lines(role: str, series: Mapping[str, Any]) -> list[str]:
    rate, longest = series["rate"]["value"], series["longest_interval"]
    joints = "1 joint" if len(series["joints"]) == 1 else f"{len(series['joints'])} joints"
    unit = "setpoints of trajectories" if series["from_trajectories"] else "messages"
    text = f"{role}s: {series['messages']} {unit} of {joints}"
    text += "" if rate is None else f" at {rate:.4g} Hz"
    text += f", {join_words(series['fields']) or 'no field'}"
    if longest is not None:
        text += f", longest interval {longest['value']:.4g} s at {longest['at']:.4g} s"
    if series["gaps"]:
        text += f", {len(series['gaps'])} gaps"
    return [text]


def _clock_lines(clock: Mapping[str, Any]) -> list[str]:
    late = clock.get("log_after_stamp", {})
    other = {role: value for role, value in late.items() if abs(value) > _OTHER_CLOCK}
    if other:
        return [
            f"clock: the stamps of {role}s are on another clock than the recorder's log times, "
            f"which are {value:.3g} s later"
            for role, value in other.items()
        ]
    if not any(late.values()):
        return []
    text = ", ".join(f"{role}s {1e3 * value:.3g} ms" for role, value in late.items())
    return [f"clock: header stamps; log times come later by {text} (median)"]


def episodes_in_words(
    found: Mapping[str, Any], model: Path | None = None, options: str = ""
) -> list[str]:
    """Return the summary of a data set: a line for each episode, and the first usable in full.

    Args:
        found: the JSON document of the command.
        model: MODEL of the command line.
        options: options of the command line that say how recordings are read.
    """
    recordings = found["recordings"]
    lines = [f"{found['recording']}: {found['kind']}, {len(recordings)} episodes"]
    for one in recordings:
        duration = one["clock"].get("duration", {}).get("value", 0.0)
        usable = "usable" if one["usable"] is not None else "cannot be used"
        lines.append(f"  {one['recording']}: {duration:.4g} s, {usable}")
    first = next((one for one in recordings if one["usable"] is not None), None)
    full = in_words("episode", first or recordings[0], model, options)
    if first is None:
        return [*lines, "the first:", *(f"  {line}" for line in full[1:-1]), full[-1]]
    lines.append("the first:" if first is recordings[0] else "the first that can be used:")
    lines += [f"  {line}" for line in full[1:-1]]
    lines.append(
        f"next: pytest-twin diagnose {model or 'MODEL'} {found['recording']}{options} "
        "--out diagnosis"
    )
    return lines
