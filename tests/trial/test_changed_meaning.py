"""Logs whose columns mean something else from a time on: said with joint and time."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from test_stream_checks import ARM, RATE, measured, write

from pytest_twin import cli
from pytest_twin.formats.recordings import read_one
from pytest_twin.trial.changed_meaning import meaning_changes
from pytest_twin.trial.stream_checks import doubts
from pytest_twin.trial.unwrap_joints import RecordedMotion

pytestmark = pytest.mark.usefixtures("commands_in_process")
RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS", Path(__file__).parents[3] / "shared" / "recordings")
)
COUNT, FROM = 2000, 800
MIDDLE = np.array([0.6, -0.9])
SECONDS = FROM / RATE
Table = np.ndarray


def sums_of_sines(seed: int) -> Table:
    """(n, 2) commands of two joints, rad: four sines of 0.1 to 0.6 Hz each."""
    draw, time = np.random.default_rng(seed), np.arange(COUNT) / RATE
    frequency, size = draw.uniform(0.1, 0.6, (2, 4)), draw.uniform(0.1, 0.4, (2, 4))
    phase = draw.uniform(0.0, 2.0 * np.pi, (2, 4))
    waves = size * np.sin(2.0 * np.pi * frequency * time[:, None, None] + phase)
    return waves.sum(axis=2) + MIDDLE


def steps(seed: int) -> Table:
    """(n, 2) commands, rad: a step each second."""
    return np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, (COUNT // 100, 2)), 100, axis=0)


def notes_of(position: Table, command: Table | None, rows: Table | None = None) -> list[str]:
    time = (np.arange(len(position)) if rows is None else rows) / RATE
    sent = np.empty((0, 0)) if command is None else command
    columns = {} if command is None else {"hip": 0, "knee": 1}
    return meaning_changes(
        RecordedMotion(
            Path("log.csv"), "/joint_states", ("hip", "knee"), time, position, time[: len(sent)],
            sent, columns,
        )
    )  # fmt: skip


def from_then_on(table: Table, change: Table) -> Table:
    """The table, and ``change`` from the time of the change on."""
    return np.concatenate([table[:FROM], change[FROM:]])


COMMAND = sums_of_sines(3)
POSITION = measured(COMMAND)
RESTING = np.broadcast_to(POSITION[FROM], POSITION.shape) + 2e-4 * np.random.default_rng(
    1
).standard_normal(POSITION.shape)


@pytest.mark.parametrize("known", [True, False], ids=["with commands", "without commands"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (POSITION[:, ::-1], "'hip' and 'knee' continue each other: their names or columns"),
        (POSITION + np.array([0.1, 0.0]), "another zero (slipped encoder, skipped tooth, homing)"),
        (POSITION * [-1.0, 1.0], "its sign is reversed"),
        (POSITION * [180.0 / np.pi, 1.0], "it is in degrees"),
    ],
)
def test_a_jump_of_the_positions_is_named(change: Table, words: str, known: bool) -> None:
    (note,) = notes_of(from_then_on(POSITION, change), COMMAND if known else None)
    assert words in note
    assert "'hip'" in note
    assert f"{SECONDS:.4g} s" in note


@pytest.mark.parametrize(
    ("position", "command", "words"),
    [
        (POSITION, COMMAND[:, ::-1], "follows the command of 'knee': names or columns"),
        (POSITION, COMMAND * [-1.0, 1.0], "runs against its command"),
        (POSITION, np.degrees(COMMAND), "times its command: another unit"),
        (RESTING, COMMAND, "does not follow its command: the drive is off"),
        (POSITION, np.broadcast_to(COMMAND[FROM], COMMAND.shape), "although its command rests"),
    ],
)
def test_commands_that_stop_meaning_what_they_did_are_named(
    position: Table, command: Table, words: str
) -> None:
    notes = notes_of(from_then_on(POSITION, position), from_then_on(COMMAND, command))
    (note,) = (note for note in notes if "'hip'" in note)
    assert words in note
    time = float(note.split("from ")[1].split(" s on")[0])
    assert time == pytest.approx(SECONDS, abs=0.15)


def test_a_joint_that_something_holds_is_not_called_switched_off() -> None:
    """A gripper closes on an object and is squeezed more or less from then on."""
    squeeze = COMMAND.copy()
    squeeze[FROM:, 0] = POSITION[FROM, 0] - 0.3 - 0.2 * np.abs(COMMAND[FROM:, 0])
    (note,) = notes_of(from_then_on(POSITION, RESTING), from_then_on(COMMAND, squeeze))[:1]
    assert "'hip' rests while its commands are all beyond it on one side: an object" in note


def test_a_tooth_that_skips_over_some_samples_is_named() -> None:
    ramp = np.clip((np.arange(COUNT) - FROM) / 8.0, 0.0, 1.0)[:, None]
    (note,) = notes_of(POSITION + 0.31 * ramp * [0.0, 1.0], COMMAND)
    assert "'knee'" in note
    assert "another zero" in note


@pytest.mark.parametrize("course", [sums_of_sines, steps])
@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_said_of_a_robot_that_follows(course: object, seed: int) -> None:
    """Also not if it is slow, loaded from a time on, or its log has outliers and lost rows."""
    command = course(seed)
    position = measured(command)
    loaded = position + from_then_on(np.zeros_like(position), np.full_like(position, 0.015))
    outliers = position.copy()
    outliers[[300, 900], 0] += 0.5
    rows = np.arange(COUNT)
    lost = np.delete(rows, np.arange(500, 530))
    for log, sent, at in (
        (position, command, rows),
        (position, None, rows),
        (loaded, command, rows),
        (outliers, command, rows),
        (position[lost], command[lost], lost),
        (position[::8], command[::8], rows[::8]),
    ):
        assert notes_of(log, sent, at) == []


@pytest.mark.parametrize("seed", range(6))
def test_noise_of_any_size_causes_no_note_and_hides_no_change(seed: int) -> None:
    """Noise and resolution of the encoders are drawn from 0.01 to 40 mrad."""
    draw = np.random.default_rng(seed)
    level, resolution = 10.0 ** draw.uniform(-5.0, np.log10(0.04), 2)
    command = sums_of_sines(seed)
    position = measured(command)
    changes = (position[:, ::-1], position * [-1.0, 1.0], position + np.array([0.31, 0.0]))

    def recorded(table: Table) -> Table:
        noisy = table + level * draw.standard_normal(table.shape)
        return resolution * np.round(noisy / resolution)

    for sent in (command, None):
        assert notes_of(recorded(position), sent) == []
    for change in changes:
        assert any(
            "'hip'" in one for one in notes_of(recorded(from_then_on(position, change)), command)
        )


def test_a_faster_motion_that_the_drive_cannot_follow_is_not_named() -> None:
    time = np.arange(COUNT) / RATE
    sweep = 0.4 * np.sin(2.0 * np.pi * (0.1 * time + 0.5 * 0.8 * time**2))
    command = np.column_stack([sweep, 0.5 * sweep]) + MIDDLE
    assert notes_of(measured(command), command) == []


def moves_and_rests(draw: np.random.Generator, rate: float) -> Table:
    """(n, 2) commands, rad: minimum-jerk moves of 0.6 to 2 s, with rests between them, 20 s."""
    columns = []
    for _ in range(2):
        parts: list[Table] = []
        start = draw.uniform(-1.2, 1.2)
        while sum(map(len, parts)) < 20.0 * rate:
            end, s = (
                draw.uniform(-1.2, 1.2),
                np.linspace(0.0, 1.0, int(draw.uniform(0.6, 2) * rate)),
            )
            parts.append(start + (end - start) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5))
            parts.append(np.full(int(draw.uniform(0.0, 1.0) * rate), end))
            start = end
        columns.append(np.concatenate(parts)[: int(20.0 * rate)])
    return np.column_stack(columns)


def follower(
    command: Table, rate: float, *, lag: float, sag: float = 0.04, dead: float = 0.01,
    fastest: float = np.inf, counts: int = 4096,
) -> Table:  # fmt: skip
    """(n, 2) positions, rad, of a servo: lag (s), sag under gravity and dead band (rad), rad/s."""
    position = [command[0]]
    for sent in command[:-1]:
        error = sent - sag * np.cos(position[-1]) - position[-1]
        error = np.sign(error) * np.maximum(np.abs(error) - dead, 0.0)
        step = error * -np.expm1(-1.0 / (lag * rate))
        position.append(position[-1] + np.clip(step, -fastest / rate, fastest / rate))
    grid = 2.0 * np.pi / counts
    return np.round(np.array(position) / grid) * grid


@pytest.mark.parametrize(
    ("rate", "servo"),
    [
        (30.0, {"lag": 0.06}),
        (30.0, {"lag": 0.12, "sag": 0.12, "dead": 0.04}),
        (30.0, {"lag": 0.06, "fastest": 1.0}),
        (50.0, {"lag": 0.06, "counts": 400}),
        (500.0, {"lag": 0.01, "sag": 0.0, "dead": 5e-4, "counts": 10**6}),
    ],
    ids=["leader and follower", "weak servo", "speed limit", "coarse encoder", "industrial arm"],
)
def test_no_make_of_servo_is_doubted(rate: float, servo: dict[str, float]) -> None:
    """Also not filtered, pushed against a table, with a load picked up, or without commands."""
    for seed in range(4):
        command = moves_and_rests(np.random.default_rng(seed), rate)
        position = follower(command, rate, **servo)
        picked_up = np.clip(np.arange(len(position)) / rate - 10.0, 0.0, 0.3) / 0.3
        smooth = np.exp(-np.arange(0.0, 0.5, 1.0 / rate) / 0.08)
        filtered = [
            np.convolve(p - p[0], smooth / smooth.sum())[: len(p)] + p[0] for p in position.T
        ]
        for log, sent in (
            (position, command),
            (position, None),
            (np.column_stack(filtered), command),
            (np.maximum(position, np.quantile(position, 0.25, axis=0)), command),
            (position - 0.08 * np.cos(position) * picked_up[:, None], command),
        ):
            time = np.arange(len(log)) * RATE / rate
            assert notes_of(log, sent, time) == []


@pytest.mark.parametrize("command", ["show", "show without commands", "replay", "convert"])
def test_every_command_that_reads_the_log_says_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    log = write(tmp_path, from_then_on(POSITION, POSITION[:, ::-1]), COMMAND)
    model, out = str(tmp_path / "arm.xml"), str(tmp_path / "out.mcap")
    assert (tmp_path / "arm.xml").read_text() == ARM
    if command == "show without commands":
        log.write_text(
            "\n".join(",".join(row.split(",")[:3]) for row in log.read_text().splitlines())
        )
    arguments = {
        "replay": ["replay", model, str(log), "--out", out],
        "convert": ["convert", str(log), "--out", out],
    }.get(command, ["show", str(log)])
    assert cli.main(arguments) == 0
    texts = capsys.readouterr()
    assert "from 8 s on the positions of 'hip' and 'knee'" in texts.out + texts.err


def test_no_recording_of_a_real_robot_is_doubted() -> None:
    """37 recordings of servos and of a drive under force commands."""
    files = sorted(RECORDINGS.glob("*/recordings/*.mcap"))
    if not files:
        pytest.skip(f"no recordings at {RECORDINGS}; the variable TWIN_RECORDINGS names the place")
    doubted = {path.name: doubts(read_one(path)) for path in files}
    assert not {name: notes for name, notes in doubted.items() if " on the position" in str(notes)}
    assert not {name: notes for name, notes in doubted.items() if "jumps from" in str(notes)}
