"""Whether a recording repeats the motion of another one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.formats.recording import TOPICS
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.trial.repeated import is_repeated
from pytest_twin.trial.repeated_motion import overlaps, without_repeated


@dataclass(frozen=True, eq=False)
class Recorded:
    """Measured positions, rad, and efforts, N*m."""

    path: Path
    joints: tuple[str, ...]
    position: np.ndarray
    effort: np.ndarray | None = None


def trial(folder: Path, name: str, *, phase: float, seconds: float, jitter: float = 0.0) -> Trial:
    """A sine of 1 Hz, commanded at 200 Hz and followed 20 ms later with noise."""
    rng = np.random.default_rng(len(name))
    time = np.arange(0.0, seconds, 0.005)
    time[1:] += jitter * rng.uniform(-1.0, 1.0, len(time) - 1)
    sent, moved = (0.5 * np.sin(2.0 * np.pi * (time - late) + phase) for late in (0.0, 0.02))
    moved = moved + 1e-3 * rng.standard_normal(len(time))
    rows = "".join(f"{t:.6f},{q:.6f},{c:.6f}\n" for t, q, c in zip(time, moved, sent, strict=True))
    path = folder / f"{name}.csv"
    path.write_text("time,a.position,a.command\n" + rows)
    (recording,) = recordings_at(path, TOPICS)
    (made,) = make_trials(recording, None, RecordingOptions(command_mode="position"))
    return made


@pytest.mark.parametrize(
    ("phase", "seconds", "is_same"),
    [(0.0, 3.0, True), (0.2, 3.0, False), (0.0, 1.5, False)],
    ids=["same commands", "other phase", "half as long"],
)
def test_a_motion_is_repeated_by_its_commands(
    tmp_path: Path, phase: float, seconds: float, is_same: bool
) -> None:
    first = trial(tmp_path, "first", phase=0.0, seconds=3.0, jitter=0.001)
    other = trial(tmp_path, "other", phase=phase, seconds=seconds, jitter=0.001)
    assert is_repeated(other, first) is is_same


def recorded(path: str, position: np.ndarray, joints: tuple[str, ...] = ("a", "b")) -> Recorded:
    return Recorded(Path(path), joints, position)


def test_recordings_that_repeat_a_measured_motion_are_left_out() -> None:
    rng = np.random.default_rng(3)
    time = 0.01 * np.arange(600)
    motion = np.column_stack([np.sin(2.0 * time), np.cos(3.0 * time)])
    first, again, third = (motion + 1e-4 * rng.standard_normal(motion.shape) for _ in range(3))
    turned = recorded("other_order.mcap", first[:, ::-1], ("b", "a"))
    cut = recorded("cut.csv", np.round(third[100:400], 6))
    fit = [recorded("fit.mcap", first), turned, cut]
    held_out = [recorded("copy.mcap", first), recorded("held_out.mcap", again)]
    held_out.append(recorded("whole.mcap", third))
    notes: list[str] = []
    kept = without_repeated(fit, held_out, notes)
    assert [[one.path.name for one in some] for some in kept] == [
        ["fit.mcap", "cut.csv"],
        ["held_out.mcap"],
    ]
    assert notes == [
        "left out: other_order.mcap: its measured motion is that of fit.mcap",
        "left out: copy.mcap: its measured motion is that of fit.mcap",
        "left out: whole.mcap: its measured motion is that of cut.csv",
    ]


def test_a_robot_at_rest_repeats_no_motion() -> None:
    notes: list[str] = []
    rest = [recorded(f"{name}.mcap", np.full((600, 2), 0.3)) for name in "ab"]
    assert without_repeated(rest, [], notes) == (rest, [])
    assert notes == []


@pytest.fixture
def precise() -> Recorded:
    """A motion without noise of its positions, and efforts with noise."""
    time = 0.01 * np.arange(600)
    motion = np.column_stack([np.sin(2.0 * time), np.cos(3.0 * time)])
    noise = 0.02 * np.random.default_rng(3).standard_normal(motion.shape)
    return Recorded(Path("first.mcap"), ("a", "b"), motion, 5.0 * motion + noise)


def test_a_precise_machine_that_repeats_a_motion_has_other_efforts(precise: Recorded) -> None:
    assert precise.effort is not None
    again = Recorded(Path("again.mcap"), ("a", "b"), precise.position, precise.effort[::-1])
    assert not overlaps(again, precise)
    assert without_repeated([precise], [again], []) == ([precise], [again])


@pytest.mark.parametrize("decimals", [4, 6])
@pytest.mark.parametrize("rows", [slice(0, 300), slice(200, None, None)])
def test_a_cut_copy_with_rounded_efforts_and_another_turn_overlaps(
    precise: Recorded, rows: slice, decimals: int
) -> None:
    assert precise.effort is not None
    copy = Recorded(
        Path("cut.csv"), ("a", "b"), np.round(precise.position[rows] + [2.0 * np.pi, 0.0], 6),
        np.round(precise.effort[rows], decimals),
    )  # fmt: skip
    assert overlaps(copy, precise)
    without_effort = Recorded(Path("positions.csv"), ("a", "b"), copy.position)
    assert overlaps(precise, without_effort)


def test_recordings_with_one_part_in_common_overlap() -> None:
    stream = np.random.default_rng(3).standard_normal((1000, 2))
    assert overlaps(recorded("one.mcap", stream[:600]), recorded("next.mcap", stream[480:]))
    assert not overlaps(recorded("one.mcap", stream[:600]), recorded("next.mcap", stream[560:]))
