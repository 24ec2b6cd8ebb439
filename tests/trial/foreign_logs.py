"""A recording of an arm whose first joint turns beyond half a turn, written as others write it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from pytest_twin import cli
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.recording import TOPICS, JointSeries
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trial, recording_at

FOLDER = Path(__file__).parent / "turning_arm"
ARM = FOLDER / "arm.xml"
"""Two joints without ranges; the recorded plant has 0.8 N*m*s/rad more damping at ``j1``."""
RECORDED = FOLDER / "unwrapped.mcap"
TRUE_RMS = {"j1": 0.03641, "j2": 0.00041}
"""rad, of a replay of ``RECORDED``."""


def recorded() -> Mapping[str, JointSeries]:
    """States and commands as the arm moved."""
    return read_recording(RECORDED).series


def write(path: Path, series: Mapping[str, JointSeries]) -> Path:
    write_recording(path, list(series.values()), {})
    return path


def changed_positions(series: JointSeries, position: np.ndarray) -> JointSeries:
    return replace(series, position=position)


def replayed(recording: Path, out: Path, *options: str) -> tuple[dict[str, float], list[str]]:
    """RMS error of each joint (rad), and the notes of a replay."""
    target = out / "predicted.mcap"
    code = cli.main(["replay", str(ARM), str(recording), "--out", str(target), *options])
    assert code == 0
    result = json.loads(target.with_suffix(".json").read_text())
    return {name: one["rms"] for name, one in result["joints"].items()}, result["notes"]


def trial_of(recording: Path, **options: object) -> Trial:
    """The trial of a recording of ``ARM``."""
    chosen = RecordingOptions(**options)  # type: ignore[arg-type]
    return make_trial(recording_at(recording, TOPICS, chosen), load(ARM).structure, chosen)
