"""Joint positions of a data set, with the joint names of the model."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Structure
from pytest_twin.errors import FormatError, RecordingError
from pytest_twin.formats.recording import Recording
from pytest_twin.formats.stamps import carriers_of
from pytest_twin.formats.stamps.joint_names import are_numbers
from pytest_twin.recording_options import JointNames
from pytest_twin.trial.joint_side import states_at_joints
from pytest_twin.trial.joints import in_model_names, name_by_actuators
from pytest_twin.trial.read import recordings_at
from pytest_twin.twin import Twin

MAX_POSES = 4000
"""Largest number of recorded poses, at equal distances."""
_DRAWN_POSES = 512
"""Number of random poses if a data set has no positions."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Joint positions at which two versions of a twin are compared.

    Attributes:
        joints: names in the model.
        positions: (n, j) encoder readings, rad or m.
        source: their origin, as text.
    """

    joints: tuple[str, ...]
    positions: FloatArray
    source: str


def recordings_of(
    dataset: Path, twin: Twin, names: JointNames, joints: Collection[str]
) -> list[Recording]:
    """Recordings of a data set; empty for a policy, and for HDF5, which has no joint names.

    Args:
        names: mapping from joint names of the data to ``joints``, those of the released twin.

    Raises:
        TwinError: a damaged recording.
    """
    try:
        recordings = recordings_at(dataset, twin.topics, twin.recordings)
    except FormatError:
        files = [c.path for c in carriers_of(dataset) if c.path.suffix.lower() == ".mcap"]
        if files == [dataset]:
            raise
        recordings = [
            one for file in files for one in recordings_at(file, twin.topics, twin.recordings)
        ]
    return [_renamed(recording, names, joints) for recording in recordings]


def _renamed(recording: Recording, names: JointNames, joints: Collection[str]) -> Recording:
    series = {
        role: replace(one, names=tuple(names.in_model(name, joints) for name in one.names))
        for role, one in recording.series.items()
    }
    return replace(recording, series=series)


def joints_of(recording: Recording, twin: Twin) -> set[str]:
    """Joints of states and commands, by their names in the twin or, unknown to it, as recorded.

    Values that are numbered from 0 for lack of names are left out.
    """
    mapping = twin.recordings.joints
    lists = (
        tuple(mapping.in_model(name, ()) for name in s.names) for s in recording.series.values()
    )
    return {name for names in lists if not are_numbers(names) for name in names}


def poses_of(recordings: Sequence[Recording], structure: Structure, twin: Twin) -> Poses | None:
    """Joint positions of recordings, sampled evenly; None where none can be read.

    Args:
        recordings: recordings of one data set.
        twin: twin with the mapping of joint names.
    """
    tables: list[FloatArray] = []
    joints: tuple[str, ...] = ()
    scalar = [joint for joint, kind in structure.joint_type.items() if kind in ("hinge", "slide")]
    for recording in recordings:
        series = recording.series.get("state")
        if series is None or series.position is None:
            continue
        series, _ = name_by_actuators(series, twin.recordings.joints, structure.actuator_joints)
        try:
            series, _ = in_model_names(series, twin.recordings.joints, scalar, recording.path)
        except RecordingError:
            continue
        series, _ = states_at_joints(series, twin.recordings.signals, recording.path)
        assert series.position is not None
        if joints and series.names != joints:
            continue
        joints = series.names
        tables.append(series.position[np.isfinite(series.position).all(axis=1)])
    positions = np.concatenate(tables) if tables else np.zeros((0, 0))
    if not len(positions):
        return None
    keep = np.unique(np.linspace(0, len(positions) - 1, MAX_POSES).astype(int))
    return Poses(joints, positions[keep], f"over this data's poses ({len(keep)} of them)")


def draw_poses(structure: Structure) -> Poses:
    """Random poses, uniform in the joint ranges, for data without joint positions.

    A joint without a range is drawn from -pi to pi rad, or from -0.1 m to 0.1 m.
    """
    joints, low, high = [], [], []
    for joint, kind in structure.joint_type.items():
        if kind not in ("hinge", "slide"):
            continue
        free = (-np.pi, np.pi) if kind == "hinge" else (-0.1, 0.1)
        lower, upper = structure.joint_range.get(joint) or free
        joints.append(joint)
        low.append(lower)
        high.append(upper)
    rng = np.random.default_rng(0)
    drawn = rng.uniform(low, high, (_DRAWN_POSES, len(joints)))
    words = f"over {_DRAWN_POSES} poses drawn within the joints' ranges"
    return Poses(tuple(joints), drawn, words)


def variants_of(recordings: Sequence[Recording]) -> dict[str, set[str]]:
    """``controller`` and ``payload`` -> ids that the recordings name."""
    return {
        key: {one.metadata[key] for one in recordings if one.metadata.get(key)}
        for key in ("controller", "payload")
    }


def first_seconds(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """First recordings with a total duration of at least ``seconds``; at least one, if any."""
    found: list[Recording] = []
    left = seconds
    for one in recordings:
        if left <= 0.0 and found:
            break
        found.append(one)
        series = one.series.get("state")
        if series is not None and len(series.stamp):
            left -= 1e-9 * float(series.stamp[-1] - series.stamp[0])
    return found
