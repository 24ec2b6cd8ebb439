"""Check a LeRobot data set: units, leader against follower, clock, limits, drift and cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.dataset.camera import check_cameras
from pytest_twin.dataset.episodes import compare_episodes, degrees_in_radians
from pytest_twin.dataset.finding import Finding, Unknown
from pytest_twin.dataset.following import Following, Motion, drift, follow, judge, unrelated
from pytest_twin.dataset.frames import check_clock, hidden_losses
from pytest_twin.errors import FormatError, RecordingError, TwinError
from pytest_twin.formats.recording import TOPICS, Recording
from pytest_twin.formats.recordings.base import ReadingOptions
from pytest_twin.formats.recordings.lerobot import INFO, Dataset, LeRobotDataset
from pytest_twin.formats.recordings.lerobot_units import (
    Unit,
    UnitError,
    episodes_in_another_unit,
    is_gripper,
)
from pytest_twin.formats.recordings.lerobot_video import cameras, episode_videos
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import make_trials
from pytest_twin.words import list_names

if TYPE_CHECKING:
    from pytest_twin.dependency import Structure

_BEYOND = math.radians(2.0)
"""rad by which an arm may be beyond its calibrated range."""
_MARKS: Mapping[str, tuple[str, str]] = {
    "stuck": ("the encoder repeats one value while the action moves", "encoder, cable and horn; or "
              "the arm was held"),
    "outlier": ("single positions far from those before and after", "read errors of the servo bus"),
    "beyond_range": ("outside the range in the robot's model", "zero of the calibration against "
                     "that of the model; the model's limits"),
    "copied": ("states are copies of the actions", "record measured positions"),
}  # fmt: skip
"""Marks of a trial that are findings -> text and next step."""
_WORDS = {"deg": "deg", "rad": "rad", "counts": "counts", "percent": "%"}


@dataclass(frozen=True, slots=True)
class _UnitVerdict:
    """Unit of the positions, and how sure it is.

    Attributes:
        unit: the unit; where it is not known, degrees, since a joint's range is 100 to 360 degrees.
        why: reason, or the question.
        is_known: whether it is stated or follows from the values.
        label: name in texts.
    """

    unit: Unit
    why: str
    is_known: bool
    label: str

    def of(self, joint: str) -> tuple[float, str]:
        """Units per rad in texts about a joint, and their name."""
        if is_gripper(joint) and joint not in self.unit.motors and self.unit.name != "rad":
            return 1.0 / Unit("deg", {}).factor, "%"
        if self.unit.name == "percent":
            return math.degrees(1.0), "deg"
        return 1.0 / self.unit.factor, self.label


def check_dataset(
    path: str, units: str | None, motor_calibration: str | None, robot: str | None
) -> dict[str, Any]:
    """Check a data set; runs in the child process.

    Args:
        path: folder of the data set.
        units: unit of the positions that the user states, or None.
        motor_calibration: the arm's calibration by LeRobot, or None.
        robot: model of the robot, for the limits of its joints, or None.

    Returns:
        The JSON document.

    Raises:
        TwinError: the data set or another file cannot be read.
    """
    folder = Path(path)
    if not LeRobotDataset().reads(folder):
        raise FormatError("not a LeRobot data set", path=folder, expected=f"a folder with {INFO}")
    calibration = None if motor_calibration is None else Path(motor_calibration)
    dataset = Dataset(folder, ReadingOptions(TOPICS, {}, units, None, calibration))
    if set(dataset.features) != set(TOPICS):
        raise RecordingError(
            "no observed states or no actions", path=folder / INFO, where="features",
            value=", ".join(dataset.features), expected="observation.state and action",
        )  # fmt: skip
    verdict = _unit(dataset)
    others = episodes_in_another_unit(dataset.positions, dataset.table["episode_index"])
    recordings = [
        one for one in dataset.recordings(verdict.unit) if _number(one) not in others
    ]  # fmt: skip
    findings, unknown = _units(verdict, others)
    clock_findings, clock_unknown = check_clock(dataset.table, dataset.info)
    findings += clock_findings
    unknown += clock_unknown
    period = _period(dataset, recordings)
    motions = _motions(recordings)
    numbers = [_number(one) for one in recordings]
    findings += _not_finite(recordings)
    structure = None if robot is None else _structure(robot)
    findings += _trial_findings(recordings, structure, verdict, unknown)
    arm = [motion for name, motion in motions.items() if not is_gripper(name)]
    if arm:
        times = [one.series["state"].stamp.astype(np.float64) for one in recordings]
        states = [np.column_stack([m.state[at] for m in arm]) for at in range(len(recordings))]
        findings += hidden_losses(times, states, numbers)
    joints = {name: follow(motion, period) for name, motion in motions.items()}
    in_unit = {name: verdict.of(name) for name in joints}
    lost, no_relation = unrelated(motions, joints, period)
    compared, doubtful = judge(joints, period, in_unit)
    findings += [*lost, *compared, *drift(joints, numbers, in_unit)]
    reported = {(one.joint, number) for one in findings for number in one.episodes}
    unlike, elsewhere = compare_episodes(motions, joints, numbers, period, in_unit, reported)
    findings += [*unlike, *degrees_in_radians(motions, verdict.unit.name)]
    unknown += [*no_relation, *doubtful, *elsewhere]
    findings += _beyond_calibration(dataset, verdict, motions)
    videos, camera_findings, camera_unknown = _cameras(dataset, recordings)
    findings += camera_findings
    unknown += [*camera_unknown, *_always_unknown(dataset, motions, robot)]
    return {
        "schema": 1,
        "dataset": path,
        "verdict": "findings" if findings else "clean",
        "format": {
            "version": str(dataset.info["codebase_version"]),
            "robot_type": dataset.info.get("robot_type"),
            "fps": dataset.info.get("fps"),
            "episodes": len(np.unique(dataset.table["episode_index"])),
            "frames": len(dataset.table["episode_index"]),
        },
        "unit": {"value": verdict.label, "known": verdict.is_known, "why": verdict.why},
        "joints": {
            name: _joint(joints[name], motions[name], *in_unit[name], numbers) for name in joints
        },
        "cameras": videos,
        "findings": [one.to_json() for one in findings],
        "unknown": [one.to_json() for one in unknown],
        "notes": [str(note) for note in dataset.notes.all()],
    }


def _unit(dataset: Dataset) -> _UnitVerdict:
    try:
        unit = dataset.unit()
    except UnitError as error:
        problem = error.problem if error.value is None else f"{error.problem} ({error.value})"
        if len(error.candidates) == 1:
            # Per cent of an unknown range is of the order of degrees.
            name = "counts" if error.candidates == ("counts",) else "deg"
            return _UnitVerdict(
                Unit(name, dataset.motors), problem, is_known=True,
                label=_WORDS[error.candidates[0]],
            )  # fmt: skip
        name = "rad" if "rad" in error.candidates else "deg"
        label = " or ".join(_WORDS[unit] for unit in error.candidates)
        return _UnitVerdict(Unit(name, dataset.motors), problem, is_known=False, label=label)
    why = "; ".join(str(note) for note in dataset.notes.all() if "units" in str(note))
    label = "deg" if unit.name == "percent" else _WORDS[unit.name]
    if unit.may_be_percent:
        return _UnitVerdict(replace(unit, unknown=frozenset()), why, False, "deg or %")
    return _UnitVerdict(replace(unit, unknown=frozenset()), why or "stated", True, label)


def _units(
    verdict: _UnitVerdict, others: Mapping[int, float]
) -> tuple[list[Finding], list[Unknown]]:
    findings, unknown = [], []
    if others:
        more = (
            "degrees, the others in rad"
            if next(iter(others.values())) > 1
            else ("rad, the others in degrees")
        )
        findings.append(Finding(
            "units", f"these episodes are in {more}; they are left out of all other checks",
            "convert them, or remove them from the data set", episodes=tuple(others),
        ))  # fmt: skip
    if verdict.unit.name == "counts":
        findings.append(Finding(
            "units", f"positions in encoder counts: {verdict.why}",
            "record through a calibrated robot of LeRobot, or convert",
        ))  # fmt: skip
    elif not verdict.is_known:
        unknown.append(Unknown(
            f"unit of the positions: {verdict.label}", verdict.why,
            "--units, with --motor-calibration FILE.json for per cent",
        ))  # fmt: skip
    elif verdict.label == "%":
        unknown.append(Unknown(
            "angles of the joints", verdict.why, "--motor-calibration FILE.json of the arm",
        ))  # fmt: skip
    return findings, unknown


def _number(recording: Recording) -> int:
    return int(recording.path.name.removeprefix("episode_"))


def _period(dataset: Dataset, recordings: Sequence[Recording]) -> float:
    fps = dataset.info.get("fps")
    if isinstance(fps, (int, float)) and 0 < fps < 1e6:
        return 1.0 / fps
    steps = np.concatenate([np.diff(one.series["state"].stamp) for one in recordings])
    usual = float(np.median(steps)) * 1e-9 if len(steps) else 0.0
    if usual <= 0.0:
        raise RecordingError(
            "neither fps nor times that advance", path=dataset.path, where="timestamp",
            expected="fps in info.json",
        )  # fmt: skip
    return usual


def _motions(recordings: Sequence[Recording]) -> dict[str, Motion]:
    """Joint -> its states and actions, of joints that have both in all frames."""
    if not recordings:
        return {}
    states, actions = (recordings[0].series[role] for role in TOPICS)
    if states.position is None or actions.position is None:
        return {}
    found = {}
    for name in states.names:
        if name not in actions.names:
            continue
        columns = states.names.index(name), actions.names.index(name)
        motion = Motion(*(
            [np.asarray(one.series[role].position)[:, column] for one in recordings]
            for role, column in zip(TOPICS, columns, strict=True)
        ))  # fmt: skip
        if all(np.isfinite(one).all() for one in (*motion.state, *motion.action)):
            found[name] = motion
    return found


def _not_finite(recordings: Sequence[Recording]) -> list[Finding]:
    """Return joints with positions that are not numbers; no comparison contains them."""
    episodes: dict[str, list[int]] = {}
    for one in recordings:
        for series in (one.series[role] for role in TOPICS):
            if series.position is None:
                continue
            lacking = np.any(~np.isfinite(np.asarray(series.position)), axis=0).tolist()
            for name, lacks in zip(series.names, lacking, strict=True):
                if lacks and _number(one) not in episodes.setdefault(name, []):
                    episodes[name].append(_number(one))
    return [
        Finding(
            "not_finite",
            "positions that are not numbers; the joint is left out of all comparisons",
            "read errors of the servo bus; remove these frames",
            name,
            tuple(numbers),
        )
        for name, numbers in episodes.items()
        if numbers
    ]


def _structure(robot: str) -> Structure:
    from pytest_twin.loaded_model import load_model

    return load_model(Path(robot)).realization.structure


def _trial_findings(
    recordings: Sequence[Recording], structure: Structure | None, verdict: _UnitVerdict,
    unknown: list[Unknown],
) -> list[Finding]:  # fmt: skip
    """Findings of the checks that every recording goes through before it is replayed."""
    marked: dict[tuple[str, str | None], list[int]] = {}
    refused: dict[str, list[int]] = {}
    options = RecordingOptions(command_mode="position")
    for one in recordings:
        try:
            trials = make_trials(one, structure, options)
        except TwinError as error:
            place = f"{error.where}: " if error.where else ""
            refused.setdefault(f"{place}{error.problem}", []).append(_number(one))
            continue
        for kind, joint in {(m.kind, m.joint) for trial in trials for m in trial.marks}:
            # An object in the gripper stops it, and per cent are no angles.
            if joint is not None and (is_gripper(joint) and kind in ("stuck", "beyond_range")):
                continue
            if kind in _MARKS and (kind != "beyond_range" or verdict.is_known):
                marked.setdefault((kind, joint), []).append(_number(one))
    if structure is not None and len(refused) == 1 and not marked:
        ((reason, numbers),) = refused.items()
        if len(numbers) == len(recordings):
            unknown.append(Unknown(
                "limits of the robot's model", reason,
                "a model whose joints have the names of the data set",
            ))  # fmt: skip
            return _trial_findings(recordings, None, verdict, unknown)
    findings = [
        Finding(kind, *_MARKS[kind], joint, tuple(numbers))
        for (kind, joint), numbers in sorted(marked.items(), key=str)
    ]
    return findings + [
        Finding("unusable", reason, "no command can use these episodes", None, tuple(numbers))
        for reason, numbers in refused.items()
    ]


def _beyond_calibration(
    dataset: Dataset, verdict: _UnitVerdict, motions: Mapping[str, Motion]
) -> list[Finding]:
    """Joints in degrees that leave the range of the arm's calibration."""
    findings = []
    for name, motion in motions.items():
        motor = dataset.motors.get(name)
        if motor is None or verdict.unit.name != "deg" or is_gripper(name):
            continue
        half = 0.5 * motor.radians
        reach = max(float(np.abs(one).max()) for one in motion.state)
        if reach > half + _BEYOND:
            findings.append(Finding(
                "limits",
                f"reaches {math.degrees(reach):.1f} deg, beyond its calibrated range of "
                f"+-{math.degrees(half):.1f} deg",
                "calibrate the arm over its whole range, or give the calibration of this arm",
                name,
            ))  # fmt: skip
    return findings


def _cameras(
    dataset: Dataset, recordings: Sequence[Recording]
) -> tuple[dict[str, Any], list[Finding], list[Unknown]]:
    names, single = cameras(dataset.info)
    durations = {
        _number(one): float(np.ptp(one.series["state"].stamp)) * 1e-9 for one in recordings
    }
    videos, unknown = {}, []
    for name in names:
        try:
            videos[name] = episode_videos(dataset.path, dataset.info, name, durations)
        except TwinError as error:
            unknown.append(Unknown(
                f"whether {name} moved", str(error), "download the videos of the data set",
            ))  # fmt: skip
    if single:
        unknown.append(Unknown(
            f"whether {list_names(single)} moved", "images inside Parquet files are not decoded",
            "convert them to videos",
        ))  # fmt: skip
    verdicts, findings, undecided = check_cameras(videos)
    for name in {*names, *single} - set(verdicts):
        verdicts[name] = {"verdict": "unknown", "why": "its videos are not there"}
    return verdicts, findings, [*unknown, *undecided]


def _always_unknown(
    dataset: Dataset, motions: Mapping[str, Motion], robot: str | None
) -> list[Unknown]:
    unknown = []
    apart = sorted({
        name for feature in dataset.features.values() for name in feature.names
    } - set(motions))  # fmt: skip
    if apart:
        unknown.append(Unknown(
            f"leader against follower of {list_names(apart)}",
            "in the states or in the actions alone, or not a position in every frame",
            "actions and states with the same names",
        ))  # fmt: skip
    unknown.append(Unknown(
        "zeros of the joints against a model of the robot",
        "LeRobot's zero is the middle of the calibrated range; leader and follower may be off "
        "together",
        "measure one pose of the follower, and compare it with the model",
    ))  # fmt: skip
    if robot is None:
        unknown.append(Unknown("limits of the robot", "no model is given", "--robot FILE"))
    if not any("effort" in f.quantities for f in dataset.features.values()):
        unknown.append(Unknown(
            "payload, friction and torque", "no efforts are recorded",
            "record the servos' current or load",
        ))  # fmt: skip
    return unknown


def _joint(
    one: Following, motion: Motion, scale: float, unit: str, numbers: Sequence[int]
) -> dict[str, Any]:
    states = np.concatenate(motion.state)
    return {
        "unit": unit,
        "range": [float(states.min()) * scale, float(states.max()) * scale],
        "offset": one.offset * scale,
        "lag": None if one.lag is None else {"value": one.lag, "unit": "s"},
        "gain": one.gain,
        "correlation": one.correlation,
        "offset_by_episode": {
            str(number): float(value) * scale
            for number, value in zip(numbers, one.by_episode, strict=True)
        },
    }
