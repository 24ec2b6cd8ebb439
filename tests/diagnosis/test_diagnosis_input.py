"""Recordings that cannot be used, in whole or in part: their notes, and the use of the others."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from two_pendulums import (
    ARMATURE,
    DAMPING,
    INERTIA,
    JOINTS,
    LENGTH,
    MASS,
    START_NS,
    STEP,
    mjcf,
    record,
    reference,
    simulate,
    write,
)

from pytest_twin import cli
from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.prepare import NOISE, prepare
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.windows import Cutting, segments_of
from pytest_twin.errors import RecordingError, SimulationError
from pytest_twin.formats.mcap import JointSeries, write_recording
from pytest_twin.loaded_model import load_model

pytestmark = pytest.mark.usefixtures("commands_in_process")


class Bench:
    """A folder with the nominal model and its recordings."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "model.xml").write_text(mjcf())
        self.loaded = load_model(folder / "model.xml")
        setpoints = reference(7, 1.5, 2)
        moved = simulate(setpoints)
        at, seen = np.arange(0, len(setpoints), 100), np.arange(0, len(setpoints), 50)
        noise = 1e-4 * np.random.default_rng(0).standard_normal((len(seen), 2))
        self.sent_at, self.sent = at * STEP, setpoints[at]
        self.seen_at, self.seen = seen * STEP, moved[seen] + noise
        self.rng = np.random.default_rng(1)

    def add(
        self,
        name: str,
        *,
        sent_at: np.ndarray | None = None,
        seen: np.ndarray | None = None,
        velocity: np.ndarray | None = None,
        joints: tuple[str, ...] = JOINTS,
        role: str | None = None,
    ) -> Path:
        path = self.folder / name
        if seen is None:
            # Encoders never repeat a motion to the last digit.
            seen = self.seen + 1e-5 * self.rng.standard_normal(self.seen.shape)
        write(
            path,
            joints,
            self.sent_at if sent_at is None else sent_at,
            self.sent[:, : len(joints)],
            self.seen_at,
            seen[:, : len(joints)],
            role,
            velocity,
        )
        return path

    def read(self, *recordings: Path, held_out: tuple[Path, ...] = ()) -> TrialSet:
        structure = self.loaded.realization.structure
        return read_trials(recordings, held_out, self.loaded.topics, structure)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def names(trials: tuple[object, ...]) -> list[str]:
    return [t.path.name for t in trials]  # type: ignore[attr-defined]


def test_the_role_comes_from_the_command_line_then_from_metadata_then_from_a_split(
    bench: Bench,
) -> None:
    a, b, c = bench.add("a.mcap"), bench.add("b.mcap", role="held_out"), bench.add("c.mcap")
    given = bench.read(a, b, held_out=(c,))
    assert (names(given.fit), names(given.held_out)) == (["a.mcap", "b.mcap"], ["c.mcap"])
    own = bench.read(a, b, c)
    assert (names(own.fit), names(own.held_out)) == (["a.mcap", "c.mcap"], ["b.mcap"])
    assert own.notes[0] == "held out (role in the metadata): b.mcap"
    split = bench.read(a, c)
    assert len(split.fit) == len(split.held_out) == 1
    assert "held out (chosen automatically): c.mcap" in split.notes[0]
    # A recording that is given twice has one role.
    assert names(bench.read(a, c, held_out=(c,)).fit) == ["a.mcap"]


def test_a_single_recording_is_not_held_out(bench: Bench) -> None:
    only = bench.read(bench.add("a.mcap"))
    assert only.held_out == ()
    assert "one recording only: nothing is held out" in only.notes[0]


def test_holding_out_all_recordings_is_an_error(bench: Bench) -> None:
    path = bench.add("a.mcap")
    with pytest.raises(RecordingError, match="no recording remains to fit"):
        bench.read(path, held_out=(path,))


def test_a_recording_that_cannot_be_used_is_left_out_with_its_reason(bench: Bench) -> None:
    broken = bench.seen.copy()
    broken[40:43, 1] = np.inf
    good = bench.add("good.mcap")
    later = bench.add("later.mcap", sent_at=bench.sent_at + 60.0)
    torn = bench.add("torn.mcap", seen=broken)
    found = bench.read(good, later, torn)
    assert names(found.fit) == ["good.mcap"]
    assert found.held_out == ()
    assert any("later.mcap" in n and "do not overlap in time" in n for n in found.notes)
    assert any("torn.mcap" in n and "not finite" in n and "right" in n for n in found.notes)
    with pytest.raises(RecordingError, match="do not overlap"):
        bench.read(later)


def test_states_without_a_position_are_left_out_and_the_recording_is_used(bench: Bench) -> None:
    holes = bench.seen.copy()
    holes[40:43, 1] = np.nan
    found = bench.read(bench.add("good.mcap"), bench.add("torn.mcap", seen=holes))
    (torn,) = found.held_out
    assert len(torn.time) == len(holes) - 3
    assert np.isfinite(torn.position).all()
    assert any("torn.mcap: 3 states without a position" in n for n in found.notes)


def test_a_recording_too_short_for_a_noise_estimate_is_left_out(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    good = bench.add("good.mcap")
    brief = record(tmp_path / "brief.mcap", 2, seconds=0.015)
    found = bench.read(good, brief)
    assert names(found.fit) == ["good.mcap"]
    assert any("brief.mcap" in n and "too few states" in n for n in found.notes)
    problem = prepare(bench.loaded.realization, found.fit, found.held_out, threads=1).problem
    assert np.isfinite(problem.floor).all()
    with pytest.raises(RecordingError, match="too few states"):
        bench.read(brief)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (np.degrees(1.0), "positions were in degrees"),
        (4096 / (2 * np.pi), "positions were in encoder counts"),
    ],
    ids=["degrees", "encoder counts"],
)
def test_states_in_another_unit_than_the_commands_are_refused(
    bench: Bench, factor: float, words: str
) -> None:
    odd = bench.add("odd.mcap", seen=bench.seen * factor)
    with pytest.raises(RecordingError, match=words):
        bench.read(odd)
    assert names(bench.read(bench.add("a.mcap"), odd).fit) == ["a.mcap"]


@pytest.mark.parametrize("end", [0.3, None], ids=["at its stop", "away from its stops"])
def test_a_joint_held_at_its_stop_is_not_taken_for_another_unit(
    bench: Bench, end: float | None
) -> None:
    bench.sent = bench.sent + 2.0
    held = bench.seen.copy()
    held[:, 0] = (0.0 if end is None else end) + 0.003 * bench.seen[:, 0]
    path = bench.add("a.mcap", seen=held)
    structure = bench.loaded.realization.structure
    bounded = replace(structure, joint_range={**structure.joint_range, "left": (-2.0, 0.3)})
    if end is None:
        with pytest.raises(RecordingError, match="commands were in encoder counts"):
            read_trials([path], (), bench.loaded.topics, bounded)
    else:
        assert names(read_trials([path], (), bench.loaded.topics, bounded).fit) == ["a.mcap"]


def test_a_held_out_recording_of_another_command_mode_is_left_out(bench: Bench) -> None:
    """The fit recordings have position commands, the held-out one has effort commands."""
    a, b = bench.add("a.mcap"), bench.add("b.mcap")
    effort = bench.folder / "effort.mcap"
    stamps = START_NS + np.rint(bench.sent_at * 1e9).astype(np.int64)
    states = START_NS + np.rint(bench.seen_at * 1e9).astype(np.int64)
    sent = JointSeries("/joint_commands", JOINTS, stamps, stamps, None, None, bench.sent)
    seen = JointSeries("/joint_states", JOINTS, states, states, bench.seen, None, None)
    write_recording(effort, [sent, seen], {})
    found = bench.read(a, held_out=(b, effort))
    assert [t.path for t in found.held_out] == [b]
    assert any(
        str(effort) in n and "effort commands, most others have position" in n for n in found.notes
    )
    alone = bench.read(a, held_out=(effort,))
    assert not alone.held_out
    assert any("no held-out recording could be used" in n for n in alone.notes)


def test_a_servo_without_recorded_commands_is_no_mismatch(bench: Bench) -> None:
    """It holds its joint against gravity at a setpoint that no recording contains."""
    files = []
    for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out")):
        setpoints = reference(seed, 4.0, 2)
        setpoints[:, 1] = 0.4
        moved = simulate(setpoints)
        settled = round(2.0 / STEP)
        setpoints, moved = setpoints[settled:], moved[settled:]
        sent, seen = np.arange(0, len(setpoints), 100), np.arange(0, len(setpoints), 50)
        noise = 1e-4 * np.random.default_rng(seed).standard_normal((len(seen), 2))
        velocity = np.gradient(moved, STEP, axis=0)[seen]
        stamps = [START_NS + np.rint(at * STEP * 1e9).astype(np.int64) for at in (sent, seen)]
        path = bench.folder / f"{role}{seed}.mcap"
        at, measured = stamps[1], moved[seen] + noise
        left = JOINTS[:1]
        commands = JointSeries(
            "/joint_commands", left, stamps[0], stamps[0], setpoints[sent][:, :1], None, None
        )
        states = JointSeries("/joint_states", JOINTS, at, at, measured, velocity, None)
        write_recording(path, [commands, states], {"role": role})
        files.append(path)
    trials = bench.read(*files)
    stretched = trials.fit[0].position[0, 1] - 0.4
    assert stretched > 0.02, "gravity must deflect the servo visibly"
    found = diagnose(bench.loaded.realization, trials, threads=1)
    assert found.verdict == "no_mismatch"
    assert list(found.errors) == ["left"]
    assert any("'right': no recording contains commands of its" in note for note in found.notes)


@pytest.mark.parametrize(
    "late", [0.0, 0.4], ids=["commanded from the start", "commanded after 0.4 s"]
)
def test_a_recording_may_begin_during_a_motion(bench: Bench, late: float) -> None:
    """It has no velocities, and may have no command at the start."""
    files = []
    for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out")):
        setpoints = reference(seed, 3.0, 2)
        moved = simulate(setpoints)
        begun = round(1.0 / STEP)
        setpoints, moved = setpoints[begun:], moved[begun:]
        sent, seen = (
            np.arange(round(late / STEP), len(setpoints), 100),
            np.arange(0, len(setpoints), 50),
        )
        noise = 1e-4 * np.random.default_rng(seed).standard_normal((len(seen), 2))
        path = bench.folder / f"{role}{seed}.mcap"
        write(path, JOINTS, sent * STEP, setpoints[sent], seen * STEP, moved[seen] + noise, role)
        files.append(path)
    trials = bench.read(*files)
    found = diagnose(bench.loaded.realization, trials, threads=1)
    assert found.verdict == "no_mismatch"
    moving = [n for n in found.notes if "moves at the start and no velocity is recorded" in n]
    # Where the trial is cut at the first command, the states before it determine the velocity.
    assert len(moving) == (0 if late else 3)
    not_commanded = [n for n in found.notes if "before its first command at 0.4 s" in n]
    assert len(not_commanded) == (3 if late else 0)


@pytest.mark.parametrize("every", [1, 15, 30])
def test_windows_contain_enough_samples_at_any_sampling_rate(bench: Bench, every: int) -> None:
    (trial,) = bench.read(bench.add("a.mcap")).fit
    assert np.median(np.diff(trial.time)) == pytest.approx(0.005)
    slow = replace(trial, time=trial.time[::every], position=trial.position[::every])
    joints = bench.loaded.realization.structure.joint_type
    windows = segments_of(bench.loaded.realization, slow, 0, list(joints), Cutting(0.25))
    assert all(len(w.time) >= 8 for w in windows)
    # Every sample is in a window, or at an edge in two, except the first few samples, which hardly
    # determine the initial velocity.
    begun = slow.time >= windows[0].start
    assert set(np.concatenate([w.time for w in windows])) == set(slow.time[begun])
    assert (~begun).sum() <= 7


def test_the_initial_velocity_at_rest_is_as_accurate_in_the_first_window_as_in_others(
    bench: Bench,
) -> None:
    """With samples on one side only, an encoder count of 1.5 mrad causes an error of 0.1 rad/s."""
    (trial,) = bench.read(bench.add("a.mcap")).fit
    random, joints = np.random.default_rng(3), bench.loaded.realization.structure.joint_type
    off = []
    for _ in range(20):
        noise = 4e-4 * random.standard_normal(trial.position.shape)
        resting = replace(trial, position=np.zeros_like(trial.position) + noise)
        windows = segments_of(bench.loaded.realization, resting, 0, list(joints), Cutting(0.5))
        off.append([w.initial_velocity for w in windows])
    first, *others = np.sqrt(np.mean(np.square(off), axis=(0, 2)))
    assert first == pytest.approx(np.mean(others), rel=0.5)


def test_a_trial_with_many_gaps_has_one_window(bench: Bench) -> None:
    (trial,) = bench.read(bench.add("a.mcap")).fit
    kept = np.flatnonzero(np.arange(len(trial.time)) % 80 < 3)
    torn = replace(trial, time=trial.time[kept], position=trial.position[kept])
    joints = bench.loaded.realization.structure.joint_type
    (window,) = segments_of(bench.loaded.realization, torn, 0, list(joints), Cutting(0.25))
    np.testing.assert_array_equal(window.time, torn.time)


@pytest.mark.parametrize("hidden", [{}, {"delay": 0.05}, {"viscous": 0.3}, {"lag": 0.05}], ids=str)
def test_a_recording_that_begins_at_rest_has_zero_initial_velocity(
    bench: Bench, hidden: dict[str, float]
) -> None:
    trials = bench.read(record(bench.folder / "a.mcap", 4, **hidden))
    problem = prepare(bench.loaded.realization, trials.fit, trials.held_out, threads=1).problem
    assert not any(s.initial_velocity.any() for s in problem.simulator.segments)


def test_a_saturated_velocity_is_reported_and_the_recording_is_used(bench: Bench) -> None:
    speed = np.clip(np.gradient(bench.seen, bench.seen_at, axis=0), -1.0, 1.0)
    found = bench.read(bench.add("a.mcap", velocity=speed))
    assert any("velocity of left is at its maximum of 1" in note for note in found.notes)


def stuck_positions(bench: Bench, first: int = 20) -> np.ndarray:
    held = bench.seen.copy()
    held[first:, 0] = held[first, 0]
    return held


@pytest.mark.parametrize("first", [20, 80], ids=["before it has moved", "after it has moved"])
def test_a_recording_with_a_stuck_encoder_is_left_out_if_others_remain(
    bench: Bench, first: int
) -> None:
    stuck = bench.add("stuck.mcap", seen=stuck_positions(bench, first))
    found = bench.read(bench.add("a.mcap"), stuck)
    assert (names(found.fit), found.unseen) == (["a.mcap"], frozenset())
    assert any("encoder of left is stuck" in note for note in found.notes)


def test_a_joint_that_friction_holds_temporarily_is_not_a_stuck_encoder(bench: Bench) -> None:
    held = bench.seen.copy()
    held[60:270, 0] = held[60, 0]
    longer = np.concatenate([held, bench.seen, bench.seen])
    bench.seen_at = np.arange(len(longer)) * 0.005
    bench.sent_at = np.arange(3 * len(bench.sent)) * 0.01
    bench.sent = np.concatenate([bench.sent] * 3)
    found = bench.read(bench.add("a.mcap", seen=longer))
    assert (names(found.fit), found.unseen) == (["a.mcap"], frozenset())
    assert any(note.startswith("stuck in /joint_states left") for note in found.notes)


def test_a_note_asks_about_degrees_in_both_states_and_commands(bench: Bench) -> None:
    bench.sent = np.degrees(bench.sent)
    found = bench.read(bench.add("a.mcap", seen=np.degrees(bench.seen)))
    assert any("turns); if states and commands are in degrees" in n for n in found.notes)


def test_a_joint_that_rests_until_the_end_is_not_stuck_if_friction_can_hold_it(
    bench: Bench,
) -> None:
    # The joint comes to rest, and its later setpoints are too close to move it.
    at_rest = bench.seen.copy()
    at_rest[80:, 0] = at_rest[80, 0]
    bench.sent = bench.sent.copy()
    slow = np.linspace(0.0, 0.25, len(bench.sent) - 40)
    bench.sent[40:, 0] = at_rest[80, 0] + slow
    found = bench.read(bench.add("a.mcap", seen=at_rest))
    assert any(note.startswith("stuck in /joint_states left") for note in found.notes)
    assert (names(found.fit), found.unseen) == (["a.mcap"], frozenset())


def test_a_joint_whose_encoder_is_stuck_in_all_recordings_is_not_evaluated(bench: Bench) -> None:
    trials = bench.read(bench.add("stuck.mcap", seen=stuck_positions(bench)))
    assert trials.unseen == {"left"}
    found = diagnose(bench.loaded.realization, trials)
    assert set(found.errors) == {"right"}
    assert found.explanation.findings == ()
    assert found.verdict == "no_mismatch"
    assert any("is not evaluated" in note for note in found.notes)


@pytest.mark.parametrize("offset", [0.0, 0.05], ids=["at its setpoint", "away from its setpoint"])
def test_a_joint_with_a_constant_reading_has_the_noise_of_the_others(
    bench: Bench, offset: float
) -> None:
    # As with a coarse encoder at rest, while only the other joint is excited.
    bench.sent, held = bench.sent.copy(), bench.seen.copy()
    bench.sent[:, 1], held[:, 1] = 0.0, offset
    trials = bench.read(bench.add("a.mcap", seen=held), bench.add("b.mcap", seen=held))
    assert trials.unseen == frozenset()
    assert any("'right': its encoder reads" in note and "noise of the others" in note
               for note in trials.notes)  # fmt: skip
    prepared = prepare(bench.loaded.realization, trials.fit, trials.held_out, threads=1)
    noise = prepared.floor_parts[NOISE]
    assert noise[1] == noise[0] > 0.0
    found = diagnose(bench.loaded.realization, trials)
    assert set(found.errors) == {"left", "right"}
    # The servo of the model moves from the reading to its setpoint within some 10 ms.
    assert found.errors["right"].before == pytest.approx(offset, rel=0.02, abs=2e-4)


def test_a_joint_with_a_constant_reading_under_effort_commands_is_not_evaluated(
    tmp_path: Path,
) -> None:
    model = re.sub(r"<position (name=\S+ joint=\S+)[^>]*>", r"<motor \1/>", mjcf())
    (tmp_path / "model.xml").write_text(model)
    loaded = load_model(tmp_path / "model.xml")
    at = 0.005 * np.arange(400)
    # The right pendulum swings freely; the left one reads 0.1 rad throughout.
    inertia = INERTIA + MASS * LENGTH**2 + ARMATURE
    falls = solve_ivp(
        lambda t, x: [x[1], (MASS * 9.81 * LENGTH * np.sin(x[0]) - DAMPING * x[1]) / inertia],
        (0.0, at[-1]), [2.6, 0.0], t_eval=at, rtol=1e-9, atol=1e-9,
    ).y[0]  # fmt: skip
    seen = np.stack([np.full(len(at), 0.1), falls], axis=1)
    seen[:, 1] += 1e-4 * np.random.default_rng(3).standard_normal(len(at))
    sent = np.zeros((len(at), 2))

    def read() -> TrialSet:
        write(tmp_path / "a.mcap", JOINTS, at, sent, at, seen, mode="effort")
        return read_trials([tmp_path / "a.mcap"], (), loaded.topics, loaded.realization.structure)

    trials = read()
    assert trials.unseen == {"left"}
    assert any("the joint is blocked" in note for note in trials.notes)
    found = diagnose(loaded.realization, trials)
    assert set(found.errors) == {"right"}
    assert found.verdict == "no_mismatch"
    seen[:, 1] = -0.2
    with pytest.raises(RecordingError, match=r"every joint has the same position .*right -0\.2"):
        read()


def test_a_joint_that_one_recording_lacks_is_left_out(bench: Bench) -> None:
    both = bench.add("both.mcap")
    one = bench.add("one.mcap", joints=("left",))
    found = diagnose(bench.loaded.realization, bench.read(both, one))
    assert set(found.errors) == {"left"}
    assert "joint 'right' is not tested: one.mcap lacks it" in found.notes
    alone = diagnose(bench.loaded.realization, bench.read(one))
    assert set(alone.errors) == {"left"}
    expected = "joint 'right' is in no recording: it is simulated from the model's initial position"
    assert any(note.startswith(expected) for note in alone.notes)


def test_a_recording_that_lacks_a_joint_is_left_out_if_most_have_it(bench: Bench) -> None:
    whole = [bench.add(f"whole{k}.mcap") for k in range(2)]
    one = bench.add("one.mcap", joints=("left",))
    trials = bench.read(*whole, one)
    assert names((*trials.fit, *trials.held_out)) == ["whole0.mcap", "whole1.mcap"]
    assert any("one.mcap: it lacks right, which most others have" in note for note in trials.notes)
    alone = bench.read(*whole, held_out=(one,))
    assert names(alone.held_out) == ["one.mcap"]


def test_a_recording_on_which_the_model_diverges_is_left_out(tmp_path: Path) -> None:
    """Impossible controller gains are no effect; the other recordings are diagnosed."""
    wild = mjcf().replace("implicitfast", "Euler").replace('forcerange="-5.0 5.0"', "")
    (tmp_path / "model.xml").write_text(wild)
    (tmp_path / "twin.yaml").write_text(
        "model: model.xml\ncontrollers: {usual: {}, wild: {left: {kp: 1.0e+9, kv: 0}}}\n"
    )
    usual = [
        record(tmp_path / f"{k}.mcap", k, viscous=0.12, metadata={"controller": "usual"})
        for k in range(2)
    ]
    odd = record(tmp_path / "odd.mcap", 2, metadata={"controller": "wild"})
    loaded = load_model(tmp_path / "twin.yaml")

    def trials(*fit: Path) -> TrialSet:
        return read_trials(fit, usual[1:], loaded.topics, loaded.realization.structure)

    found = diagnose(loaded.realization, trials(usual[0], odd))
    assert [f.effect for f in found.explanation.findings] == ["viscous_friction"]
    (note,) = [n for n in found.notes if n.startswith("left out: ")]
    assert note == f"left out: {odd}: the simulation of the model diverges"
    with pytest.raises(SimulationError) as refused_effects:
        diagnose(loaded.realization, trials(odd))
    assert "odd.mcap: the simulation of the model diverges under the recorded commands" in str(
        refused_effects.value
    )


def test_unusable_input_gives_a_message_of_one_line_and_no_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = Bench(tmp_path)
    later = bench.add("later.mcap", sent_at=bench.sent_at + 60.0)
    arguments = ["diagnose", "--seconds", "0", str(tmp_path / "model.xml"), str(later)]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "later.mcap" in printed.err
    assert "expected one clock" in printed.err
    assert {p.name for p in tmp_path.iterdir()} == {"model.xml", "later.mcap"}


def test_an_output_folder_with_other_files_is_not_replaced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    (tmp_path / "mine" / "diagnosis.json").write_text("{}")
    record(tmp_path / "a.mcap", 1, seconds=1.0)
    (tmp_path / "model.xml").write_text(mjcf())
    words = ["diagnose", "--seconds", "0", str(tmp_path / "model.xml"), str(tmp_path / "a.mcap")]
    assert cli.main([*words, "--out", str(tmp_path / "mine")]) == 2
    assert "is not replaced" in capsys.readouterr().err
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"
