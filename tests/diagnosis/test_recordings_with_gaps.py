"""Recordings with lost messages: the parts between the gaps are trials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import START_NS

from pytest_twin.diagnosis.locate import smooth_motions
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.diagnosis.windows import Cutting, segments_of
from pytest_twin.effects.memory_warmup import WARM_UP_TIME
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.loaded_model import load_model
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization, load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import make_trial

MODEL = """\
<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><worldbody><body>
<joint name="j1" axis="0 1 0" damping="0.5"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"
mass="1" contype="0" conaffinity="0"/></body></worldbody>
<actuator><position joint="j1" kp="20" kv="1"/></actuator></mujoco>
"""
TIME = 0.01 * np.arange(400)
SENT = 0.6 * np.sin(4.0 * TIME) + 0.3 * np.sign(np.sin(7.0 * TIME))


def series(topic: str, time: np.ndarray, position: np.ndarray) -> JointSeries:
    stamp = START_NS + np.rint(time * 1e9).astype(np.int64)
    return JointSeries(topic, ("j1",), stamp, stamp, position[:, None], None, None)


class Bench:
    """A folder with a pendulum and recordings of it with gaps."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "pend.xml").write_text(MODEL)
        self.loaded = load_model(folder / "pend.xml")
        (folder / "robot.xml").write_text(MODEL.replace('timestep="0.002"', 'timestep="0.0001"'))
        whole = make_trial(read_recording(self.write_recording_with_gaps("whole.mcap", 0.9 * SENT)))
        (simulated,) = replay(load(folder / "robot.xml"), [whole])
        noise = 1e-4 * np.random.default_rng(1).standard_normal(len(TIME))
        self.seen = simulated.position[:, 0] + noise

    @property
    def realization(self) -> Realization:
        return self.loaded.realization

    def write_recording_with_gaps(
        self, name: str, seen: np.ndarray, *gaps: tuple[int, int]
    ) -> Path:
        keep = np.ones(len(TIME), dtype=bool)
        for first, end in gaps:
            keep[first:end] = False
        topics = [
            series("/joint_states", TIME[keep], seen[keep]),
            series("/joint_commands", TIME[keep], SENT[keep]),
        ]
        write_recording(self.folder / name, topics, {})
        return self.folder / name

    def read(self, *paths: Path, options: RecordingOptions | None = None) -> TrialSet:
        return read_trials(
            paths, (), self.loaded.topics, self.realization.structure, options or RecordingOptions()
        )


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_the_parts_before_and_after_a_gap_are_trials_and_a_note_says_so(bench: Bench) -> None:
    only = bench.read(bench.write_recording_with_gaps("a.mcap", bench.seen, (150, 180)))
    assert [t.name for t in only.fit] == ["a.mcap from 0 s", "a.mcap from 1.8 s"]
    assert any("a.mcap: cut into 2 parts" in note for note in only.notes)
    # Two parts of one recording do not count as two recordings.
    assert only.held_out == ()
    assert any("one recording only" in note for note in only.notes)


def test_all_parts_of_a_recording_have_the_same_role(bench: Bench) -> None:
    paths = [
        bench.write_recording_with_gaps(f"{k}.mcap", bench.seen + 1e-5 * k, (150, 180))
        for k in range(4)
    ]
    found = bench.read(*paths)
    fit, held_out = ({t.path.name for t in role} for role in (found.fit, found.held_out))
    assert (fit, held_out) == ({"0.mcap", "1.mcap", "2.mcap"}, {"3.mcap"})
    assert len(found.fit) == 6


def test_a_part_that_is_too_short_is_left_out_with_a_note(bench: Bench) -> None:
    found = bench.read(
        bench.write_recording_with_gaps("a.mcap", bench.seen, (150, 180), (230, 260))
    )
    assert [round(t.offset, 2) for t in found.fit] == [0.0, 2.6]
    (note,) = [n for n in found.notes if n.startswith("left out")]
    assert "a part between gaps is too short for a diagnosis (got '0.49' s; expected at least" in (
        note
    )
    assert "from 1.8 s" in note


def test_a_part_after_a_gap_begins_in_motion_when_lost_commands_have_no_influence_left(
    bench: Bench,
) -> None:
    first, second = bench.read(
        bench.write_recording_with_gaps("a.mcap", bench.seen, (150, 180))
    ).fit
    (from_rest,) = segments_of(bench.realization, first, 0, ("j1",), Cutting(skips_hole=True))
    (later,) = segments_of(bench.realization, second, 1, ("j1",), Cutting(skips_hole=True))
    assert not from_rest.starts_in_motion
    assert later.starts_in_motion
    assert later.start == pytest.approx(WARM_UP_TIME, abs=0.1)
    assert later.time[-1] == pytest.approx(second.duration)


def test_the_exact_model_leaves_only_noise_in_the_parts(bench: Bench) -> None:
    trials = bench.read(bench.write_recording_with_gaps("a.mcap", bench.seen, (150, 180)))
    problem = prepare(bench.realization, trials.fit, []).problem
    left = problem.residuals([EMPTY], problem.fit)[0][:, 0]
    assert float(np.sqrt(np.mean(left**2))) < 1.5 * float(problem.floor[0])


def test_times_of_parts_are_on_the_clock_of_the_recording(bench: Bench) -> None:
    trials = bench.read(bench.write_recording_with_gaps("a.mcap", bench.seen, (150, 180)))
    prepared = prepare(bench.realization, trials.fit, [])
    first, second = smooth_motions(prepared, trials.fit)
    assert first.name == second.name == "a.mcap"
    assert first.time[0] == 0.0
    assert second.time[-1] == pytest.approx(TIME[-1])


def test_the_declared_interpolation_of_commands_is_simulated(bench: Bench) -> None:
    path = bench.write_recording_with_gaps("a.mcap", bench.seen)
    for between in ("held", "interpolated", "ramped"):
        options = RecordingOptions(command_between=between)  # type: ignore[arg-type]
        (trial,) = bench.read(path, options=options).fit
        (segment,) = segments_of(bench.realization, trial, 0, ("j1",))
        at = np.array([0.504, 1.237])
        assert segment.setpoint.at(at) == pytest.approx(trial.setpoint.at(at))
        assert segment.is_interpolated == (between != "held")
        assert not any("assumed" in note for note in bench.read(path, options=options).notes)
    assert any("held between their stamps (assumed" in note for note in bench.read(path).notes)


def test_a_pause_of_the_commands_alone_is_no_gap(bench: Bench) -> None:
    keep = np.r_[0:150, 250:400]
    write_recording(
        bench.folder / "pause.mcap",
        [
            series("/joint_states", TIME, bench.seen),
            series("/joint_commands", TIME[keep], SENT[keep]),
        ],
        {},
    )
    (trial,) = bench.read(bench.folder / "pause.mcap").fit
    assert trial.parts == 1
    (sent,) = trial.commands_before(np.array([2.0]))
    assert sent[0] == SENT[149]


def test_a_trial_with_two_command_modes_states_the_mode_of_each_joint(bench: Bench) -> None:
    (trial,) = bench.read(bench.write_recording_with_gaps("a.mcap", bench.seen)).fit
    both = replace(trial, command_joints=("j1", "j2"), command_modes=("position", "effort"))
    assert both.command_mode == "mixed"
    assert (both.hardest_mode, both.mode_of("j1"), both.mode_of("j3")) == (
        "effort", "position", None,
    )  # fmt: skip
