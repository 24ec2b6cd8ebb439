"""Split recordings into fitted and held-out ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pytest_twin.errors import RecordingError, TwinError
from pytest_twin.estimation.roles import NOTHING_HELD_OUT, split_by_role
from pytest_twin.identification.measured_recordings import (
    MeasuredRecording,
    MeasuredRecordings,
    read_measured,
)
from pytest_twin.realization import Realization
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.signals import Signals
from pytest_twin.trial.repeated_motion import without_repeated

NO_PAYLOAD = frozenset({"none", "no", "empty", "0"})
"""Names of a payload that mean that there is none."""


def read_by_role(
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    realization: Realization,
    topics: Mapping[str, str],
    options: RecordingOptions,
    signals: Signals,
) -> MeasuredRecordings:
    """Read every recording and assign its role.

    The roles follow from ``held_out``, else from the metadata ``role`` of the recordings, else the
    last of every four recordings is held out.

    Args:
        recordings, held_out: files and folders; the latter need not be among the former.
        topics: role of a topic (``state``, ``command``) -> topic.
        options: settings for reading recordings.
        signals: meaning of the recorded signals.

    Raises:
        TwinError: a recording cannot be read, or there is none to fit.
    """
    notes: list[str] = []
    known: dict[Path, list[MeasuredRecording]] = {}
    errors: list[TwinError] = []
    for path in dict.fromkeys([*recordings, *held_out]):
        try:
            known[path] = read_measured(path, realization, topics, options, signals)
        except TwinError as error:
            errors.append(error)
            notes.append(f"left out: {error}")
    fit = [path for path in dict.fromkeys(recordings) if path in known and path not in held_out]
    if errors and not fit:
        raise errors[0]
    fit, aside = split_by_role(
        fit,
        [path for path in held_out if path in known],
        lambda path: known[path][0].metadata.get("role") if known[path] else None,
        lambda path: path,
        notes,
        is_named=bool(held_out),
    )
    fitted, tested = without_repeated(
        [one for path in fit for one in known[path]],
        [one for path in aside for one in known[path]],
        notes,
    )
    if aside and not tested:
        notes.append(NOTHING_HELD_OUT)
    notes += _unknown_payloads(realization, [*fitted, *tested])
    return reduce_to_common_joints(fitted, tested, notes)


def _unknown_payloads(
    realization: Realization, recordings: Sequence[MeasuredRecording]
) -> list[str]:
    """Return a note for each payload that recordings name and the twin does not state."""
    stated = () if realization.twin is None else realization.twin.payloads
    named: dict[str, list[str]] = {}
    for one in recordings:
        payload = one.metadata.get("payload", "")
        if payload and payload.lower() not in NO_PAYLOAD and payload not in stated:
            named.setdefault(payload, []).append(one.path.name)
    return [
        f"payload {payload!r} of {', '.join(dict.fromkeys(files))} is not under payloads: in "
        "twin.yaml: it is identified as a part of the robot"
        for payload, files in named.items()
    ]


def reduce_to_common_joints(
    fit: list[MeasuredRecording], held_out: list[MeasuredRecording], notes: list[str]
) -> MeasuredRecordings:
    """Reduce every recording to the same joints in the same order."""
    everything = [*fit, *held_out]
    shared = [j for j in fit[0].joints if all(j in one.joints for one in everything)]
    lost = dict.fromkeys(j for one in everything for j in one.joints if j not in shared)
    if lost:
        notes.append(f"left out, not in every recording: {', '.join(lost)}")
    if not shared:
        raise RecordingError(
            "the recordings share no joint",
            path=everything[-1].path,
            value=", ".join(everything[-1].joints),
            expected=f"joints of {fit[0].path.name}: {', '.join(fit[0].joints)}",
        )
    return MeasuredRecordings(
        tuple(_select_joints(one, shared) for one in fit),
        tuple(_select_joints(one, shared) for one in held_out),
        tuple(notes),
    )


def _select_joints(one: MeasuredRecording, joints: list[str]) -> MeasuredRecording:
    if list(one.joints) == joints:
        return one
    at = np.array([one.joints.index(j) for j in joints])
    return replace(
        one,
        joints=tuple(joints),
        position=one.position[:, at],
        velocity=None if one.velocity is None else one.velocity[:, at],
        effort=one.effort[:, at],
        command=None if one.command is None else one.command[:, at],
        unscaled=one.unscaled[at],
        limit=one.limit[at],
    )
