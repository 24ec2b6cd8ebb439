"""Mistakes in recorded positions are reported: unit, side of the gear, clipped readings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import NOMINAL, TRUE, write_model
from test_wrong_signals import identified, measured

from pytest_twin.identification.effort.position_mistakes import clipped_ends, position_mistakes
from pytest_twin.identification.measured_recordings import MeasuredRecording
from pytest_twin.realization import load
from pytest_twin.signals import Signals

RANGES = TRUE.format(**NOMINAL).replace("<joint ", '<joint limited="true" range="-180 180" ')
TIME = np.linspace(0.0, 20.0, 2001)


def spans(folder: Path, factor: float, gear: float = 1.0) -> list[str]:
    """Suspicions about positions that are ``factor`` times those of an arm with joint ranges."""
    write_model(folder)
    (folder / "model.xml").write_text(RANGES)
    one = measured(folder, 1, seconds=4.0)
    large = replace(one, position=one.position * factor)
    robot = load(folder / "model.xml")
    return [mistake.what for mistake in position_mistakes(robot, [large], [gear, gear])]


def test_positions_within_the_range_cause_no_suspicion(tmp_path: Path) -> None:
    assert spans(tmp_path, 1.0, gear=100.0) == []


def test_positions_in_degrees_are_reported_by_the_range_of_the_joint(tmp_path: Path) -> None:
    found = spans(tmp_path, 180.0 / np.pi)
    assert len(found) == 2
    assert all(what.endswith("they seem to be in degrees") for what in found)


@pytest.mark.parametrize(
    ("factor", "gear", "words"),
    [
        (100.0, 100.0, "the gear ratio 100 is not applied"),
        (1e4, 0.01, "the gear ratio 0.01 is applied the wrong way round"),
        (1000.0, 1.0, "another unit, the motor's side of a gear, or another joint"),
    ],
)
def test_positions_far_beyond_the_range_are_reported_with_the_gear_ratio(
    tmp_path: Path, factor: float, gear: float, words: str
) -> None:
    found = spans(tmp_path, factor, gear)
    assert len(found) == 2
    assert all(words in what for what in found)


def test_a_gear_ratio_applied_to_positions_of_the_joint_is_reported(tmp_path: Path) -> None:
    def divided(one: MeasuredRecording) -> MeasuredRecording:
        return replace(one, position=one.position / np.array([1.0, 50.0]))

    signals = Signals.from_json({"joints": {"elbow": {"gear": 50.0}}})
    found = identified(tmp_path, divided, signals).suspected
    (elbow,) = (one for one in found if one.mend.startswith("signals: joints: elbow: position"))
    assert "along 50 times as much the model explains the effort better" in elbow.what
    assert elbow.mend == "signals: joints: elbow: position: {side: output}"


def test_clipped_positions_are_found_once_for_each_time() -> None:
    wave = np.round(np.sin(1.5 * TIME), 4)
    assert clipped_ends(wave) == []
    assert clipped_ends(np.clip(wave, -2.0, 0.7)) == [0.7] * 5
    assert clipped_ends(np.clip(wave, -0.7, 0.7)) == [0.7] * 5 + [-0.7] * 4


def test_a_joint_that_stops_or_jumps_is_not_called_clipped() -> None:
    steps = np.sign(np.sin(TIME))
    assert clipped_ends(steps) == []
    smooth = np.convolve(np.pad(steps, 20, mode="edge"), np.hanning(41) / 20.0, mode="valid")
    assert clipped_ends(np.round(smooth, 4)) == []


def test_clipped_positions_reject_the_result(tmp_path: Path) -> None:
    def clipped(one: MeasuredRecording) -> MeasuredRecording:
        top = 0.6 * one.position[:, 1].max()
        position = one.position.copy()
        position[:, 1] = np.minimum(position[:, 1], top)
        return replace(one, position=position)

    suspected = [one for one in identified(tmp_path, clipped).suspected if one.is_fatal]
    assert any(one.what.startswith("elbow: positions stop in motion at") for one in suspected)
