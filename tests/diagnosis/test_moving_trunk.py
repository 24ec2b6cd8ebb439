"""Diagnoses of a robot whose floating base moves along its recorded pose."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.diagnosis.first_order.measured_trajectory import MeasuredTrajectory
from pytest_twin.diagnosis.first_order.rigid_terms import rigid_terms
from pytest_twin.diagnosis.problem import replay_nominal
from pytest_twin.diagnosis.windows import Cutting, segments_of
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization, load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.twin import DEFAULT_TOPICS

sys.path.insert(0, str(Path(__file__).parents[1] / "replay"))
from moving_trunk import FREE, JOINTS, Motion, moved_trunk

pytestmark = pytest.mark.usefixtures("commands_in_process")
NOISE = 2e-4


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Realization:
    path = tmp_path_factory.mktemp("trunk") / "free.xml"
    path.write_text(FREE)
    return load(path)


@pytest.fixture(scope="module")
def trial(robot: Realization) -> Trial:
    log = moved_trunk(1, Motion(noise=NOISE)).write(robot.path.with_name("a.csv"))
    options = RecordingOptions(command_between="interpolated")
    (recording,) = recordings_at(log, DEFAULT_TOPICS, options)
    (read,) = make_trials(recording, robot.structure, options)
    return read


def test_a_whole_recording_is_simulated_as_by_replay(robot: Realization, trial: Trial) -> None:
    (replayed,) = replay(robot, [trial])
    segments = segments_of(robot, trial, 0, JOINTS)
    (predicted,) = replay_nominal(BatchSimulator(segments, JOINTS))
    assert predicted.position == pytest.approx(replayed.position, abs=1e-12)


def test_windows_begin_on_the_moving_base(robot: Realization, trial: Trial) -> None:
    segments = segments_of(robot, trial, 0, JOINTS, Cutting(0.5))
    assert len(segments) > 4
    predicted = replay_nominal(BatchSimulator(segments, JOINTS, refine=4))
    errors = [p.position - s.position for p, s in zip(predicted, segments, strict=True)]
    assert np.std(np.concatenate(errors[:-1])) < 2.0 * NOISE


def test_inverse_dynamics_contain_the_acceleration_of_the_base(
    robot: Realization, trial: Trial
) -> None:
    (segment,) = segments_of(robot, trial, 0, JOINTS)
    time = np.linspace(0.5, 3.0, 9)
    random = np.random.default_rng(0)
    q, v, a = random.uniform(-1.0, 1.0, (3, 1, len(time), 2))
    nothing = np.zeros_like(q)
    along = MeasuredTrajectory(
        np.array([0]), 1, 0.5, time[None], q, v, a, q, v, (), (), nothing > 0, nothing[0, 0]
    )
    (terms,) = rigid_terms(BatchSimulator([segment], JOINTS), along)
    assert segment.base is not None
    data = mujoco.MjData(robot.model)
    for k in terms.at:
        segment.base.place(data, float(time[k]))
        data.qpos[-2:], data.qvel[-2:], data.qacc[-2:] = q[0, k], v[0, k], a[0, k]
        passive = np.array([0.05, 0.05]) * v[0, k]
        mujoco.mj_inverse(robot.model, data)
        assert terms.effort[0, k] == pytest.approx(data.qfrc_inverse[-2:] - passive, abs=1e-6)


def test_missing_friction_of_a_leg_is_named(tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    motion = Motion(seconds=3.0, added_damping=0.15, noise=NOISE)
    logs = [str(moved_trunk(seed, motion).write(tmp_path / f"{seed}.csv")) for seed in (1, 2, 3)]
    words = ["diagnose", str(tmp_path / "free.xml"), *logs[:2], "--held-out", logs[2]]
    options = ["--command-between", "interpolated", "--seconds", "60"]
    cli.main([*words, *options, "--out", str(tmp_path / "out")])
    document = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    first = document["findings"][0]
    assert (first["effect"], first["joint"]) == ("viscous_friction", "knee")
    low, high = first["parameters"]["coefficient"]["ci95"]
    assert low - 0.01 <= 0.15 <= high + 0.01
