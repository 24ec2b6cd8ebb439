"""What no model can explain: where a motion really began, what an effort sensor means, how loud."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from two_pendulums import START_NS, case

from pytest_twin.arrays import FloatArray
from pytest_twin.commands.replay import load_model
from pytest_twin.diagnosis.hypothesis import EMPTY
from pytest_twin.diagnosis.noise import timing_noise
from pytest_twin.diagnosis.prepare import NOISE as SENSOR
from pytest_twin.diagnosis.prepare import STEP as STEPS
from pytest_twin.diagnosis.prepare import Prepared, prepare
from pytest_twin.diagnosis.search.model_comparison import ModelComparison
from pytest_twin.diagnosis.search.simulation_shortlist import effort_sensor_terms
from pytest_twin.diagnosis.search.stepwise_selection import StepwiseSelection
from pytest_twin.diagnosis.search_result import search
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.trial import Trial, make_trial

STEP, TICK, SECONDS, NOISE = 0.001, 0.01, 3.0, 3e-4


def mjcf(drive: str) -> str:
    return (
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
        '<inertial pos="0 0 -0.2" mass="1" diaginertia="0.002 0.002 0.002"/>'
        '<joint name="j" axis="0 -1 0" armature="0.01" damping="0.1"/></body></worldbody>'
        f"<actuator>{drive}</actuator></mujoco>"
    )


VELOCITY = '<velocity name="j" joint="j" kv="4"/>'
POSITION = '<position name="j" joint="j" kp="200" kv="6"/>'


def moved(drive: str, command: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Commands (ticks,) to plain MuJoCo; stamps s, positions rad and efforts N*m every 10 ms."""
    model = mujoco.MjModel.from_xml_string(mjcf(drive))
    data = mujoco.MjData(model)
    each = round(TICK / STEP)
    time, position, effort = np.empty((3, len(command) * each))
    for k in range(len(time)):
        data.ctrl[0] = command[k // each]
        mujoco.mj_forward(model, data)
        time[k], position[k], effort[k] = data.time, data.qpos[0], data.qfrc_actuator[0]
        mujoco.mj_step(model, data)
    # Sensors that are not in step with commands.
    return time[4::each], position[4::each], effort[4::each]


def trial_of(
    folder: Path, drive: str, command: FloatArray, *, first: float = 0.0, noise: float = NOISE
) -> Trial:
    """A recording of it whose first reading is ``first`` deviations off."""
    time, position, effort = moved(drive, command)
    random = np.random.default_rng(3)
    off = random.standard_normal(len(time))
    off[0] = first
    (folder / "model.xml").write_text(mjcf(drive))

    def series(topic: str, at: FloatArray, **fields: FloatArray) -> JointSeries:
        stamps = START_NS + np.rint(at * 1e9).astype(np.int64)
        given = {n: fields[n][:, None] if n in fields else None for n in
                 ("position", "velocity", "effort")}  # fmt: skip
        return JointSeries(topic, ("j",), stamps, stamps, **given)

    field = "velocity" if "velocity" in drive else "position"
    sent = TICK * np.arange(len(command))
    loud = effort + 0.02 * random.standard_normal(len(time))
    write_recording(
        folder / "a.mcap",
        [
            series("/joint_commands", sent, **{field: command}),
            series("/joint_states", time, position=position + noise * off, effort=loud),
        ],
        {},
    )
    return make_trial(read_recording(folder / "a.mcap"))


def prepared(folder: Path, trial: Trial) -> Prepared:
    return prepare(load_model(folder / "model.xml").realization, [trial], [], threads=1)


def wave(ticks: int, size: float) -> FloatArray:
    t: FloatArray = TICK * np.arange(ticks, dtype=np.float64)
    return np.asarray(size * np.sin(2.0 * np.pi * 0.7 * t) * np.minimum(t / 0.3, 1.0))


def test_a_velocity_servo_does_not_know_where_it_began(tmp_path: Path) -> None:
    """It keeps the first reading's error for ever; nothing is missing in the model."""
    trial = trial_of(tmp_path, VELOCITY, wave(300, 0.8), first=5.0)
    problem = prepared(tmp_path, trial).problem
    residual = problem.residuals([EMPTY], problem.fit)[0][:, 0]
    assert np.sqrt(np.mean(residual**2)) < 1.2 * problem.floor[0]
    problem.starts = {}
    kept = problem.residuals([EMPTY], problem.fit)[0][:, 0]
    assert np.sqrt(np.mean(kept**2)) > 2.0 * problem.floor[0]


def test_a_start_is_only_as_free_as_its_samples_leave_it(tmp_path: Path) -> None:
    """What the samples around the start say stands against a shift of a hundred deviations."""
    trial = trial_of(tmp_path, VELOCITY, wave(300, 0.8))
    shifted = replace(trial, position=trial.position + 100.0 * NOISE)
    shifted.position[0] = trial.position[0]
    problem = prepared(tmp_path, shifted).problem
    residual = problem.residuals([EMPTY], problem.fit)[0][:, 0]
    assert np.sqrt(np.mean(residual**2)) > 10.0 * problem.floor[0]


@pytest.mark.parametrize(("unsigned", "takes_part"), [(False, True), (True, False)])
def test_a_current_without_a_sign_is_no_effort(
    tmp_path: Path, unsigned: bool, takes_part: bool
) -> None:
    trial = trial_of(tmp_path, POSITION, wave(300, 0.8))
    assert trial.effort is not None
    if unsigned:
        trial = replace(trial, effort=np.abs(trial.effort))
    assert (prepared(tmp_path, trial).problem.effort_floor is not None) is takes_part


def test_an_effort_that_never_changes_its_sign_may_be_one(tmp_path: Path) -> None:
    """Held up against gravity on one side, the model as well pulls one way only."""
    trial = trial_of(tmp_path, POSITION, 0.9 + wave(300, 0.02))
    trial = replace(trial, **{n: getattr(trial, n)[100:] for n in ("time", "position", "effort")})
    assert trial.effort is not None
    assert trial.effort.min() > 0.0
    trial = replace(trial, time=trial.time - trial.time[0], command_time=trial.command_time - 1.0)
    assert prepared(tmp_path, trial).problem.effort_floor is not None


def test_a_stiff_servo_is_not_a_loud_effort_sensor(tmp_path: Path) -> None:
    """Its effort jumps at every command; the floor is of the sensor's order, not of the jumps'."""
    steps = np.repeat(np.random.default_rng(1).uniform(-0.2, 0.2, 100), 3)
    trial = trial_of(tmp_path, POSITION, steps)
    floor = prepared(tmp_path, trial).problem.effort_floor
    assert floor is not None
    assert trial.effort is not None
    jumps = np.abs(np.diff(trial.effort[:, 0])).max()
    assert 0.015 < floor[0] < 0.05 * jumps


@pytest.mark.parametrize(("scale", "stands_out"), [(1.0, False), (0.8, True)])
def test_a_scale_of_efforts_stands_out_among_jumps(
    tmp_path: Path, scale: float, stands_out: bool
) -> None:
    """Samples beside jumps say little, those between them tell a fifth."""
    steps = np.repeat(np.random.default_rng(1).uniform(-0.2, 0.2, 30), 10)
    trial = trial_of(tmp_path, POSITION, steps)
    assert trial.effort is not None
    problem = prepared(tmp_path, replace(trial, effort=scale * trial.effort)).problem
    assert problem.effort_floor is not None
    off = problem.residuals([EMPTY], problem.fit)[0][:, 1]
    level = float(np.sqrt(np.mean(off**2))) / problem.effort_floor[0]
    assert bool(level > 2.0) is stands_out, level
    # Its laws are simulated, whatever means along the motion say of them, until they are named.
    problem.effort_floor *= level / (1.6 if stands_out else 1.4)
    best = ModelComparison(problem).nominal
    starts = effort_sensor_terms(problem, best)
    effects = {h.terms[-1].effect for h in starts}
    assert effects == ({"effort_scale", "effort_bias"} if stands_out else set())
    for start in starts:
        named = replace(best, fitted=replace(best.fitted, hypothesis=start))
        others = [h.terms for h in effort_sensor_terms(problem, named)]
        assert [t[-1].effect for t in others] == [*(effects - {start.terms[-1].effect})]


def test_a_sample_in_the_step_in_which_a_command_jumps_is_not_trusted(tmp_path: Path) -> None:
    """The model's drive is sent a mean of both commands there, and the sensor saw one. Where the
    drive is at its limit under any such mean, a finer step changes nothing, and does not say so.
    """
    limited = POSITION.replace("/>", ' forcerange="-4 4"/>')
    trial = trial_of(tmp_path, limited, np.repeat([0.0, 0.3, -0.1], 100))

    def weights(sampled: float, sent: float) -> FloatArray:
        """Of samples and commands at so many steps after each tick."""
        moved_on = replace(
            trial,
            time=trial.time + (sampled - 4.0) * STEP,
            command_time=trial.command_time + sent * STEP,
        )
        (found,) = prepared(tmp_path, moved_on).problem.effort_weights.values()
        return found[:, 0]

    # The hundredth sample is the first under the second command.
    for sampled, sent in ((4.0, 4.3), (4.2, 4.3), (4.6, 4.3), (4.7, 4.6)):
        found = weights(sampled, sent)
        assert (found[[100, 200]] < 0.01).all(), found[[100, 200]]
        # All other commands repeat the one before.
        assert (np.delete(found, [100, 200]) > 0.5).mean() > 0.9


def test_what_timing_makes_of_a_noise_is_no_more_than_it(tmp_path: Path) -> None:
    """A joint that creeps and then swings: over all of it late stamps cost more than is usual."""
    t = TICK * np.arange(300)
    command = 0.3 * np.sin(2.0 * np.pi * 0.3 * t) + 0.6 * np.sin(20.0 * t) * (t > 2.2)
    trial = trial_of(tmp_path, POSITION, command, noise=1e-6)
    late = 2e-3 * np.random.default_rng(0).uniform(-1.0, 1.0, len(trial.time))
    late[0] = 0.0
    trial = replace(trial, time=trial.time + late)
    found = prepared(tmp_path, trial)
    usual, timing, _ = found.floor_parts.values()
    everywhere = timing_noise(found.problem.simulator.segments, [0])
    assert everywhere[0] > 1.5 * usual[0], "or there is nothing to cap"
    assert timing[0] == usual[0]


def raised(found: Prepared, times: float) -> float:
    """Say that the step was so many times as far off as the sensor is loud; the floor, rad."""
    problem = found.problem
    steps = times * found.floor_parts[SENSOR] / problem.step_left
    found.floor_parts[STEPS] = steps
    problem.floor = np.hypot(found.floor_parts[SENSOR], problem.step_left * steps)
    return float(problem.floor[0])


def test_a_floor_of_where_the_model_ran_to_is_lowered_at_what_was_found(tmp_path: Path) -> None:
    found = prepared(tmp_path, trial_of(tmp_path, POSITION, wave(300, 0.8)))
    measured, steps = found.problem.floor.copy(), found.floor_parts[STEPS].copy()
    raised(found, 10.0)
    assert found.lowers_floor(EMPTY)
    np.testing.assert_allclose(found.problem.floor, measured, rtol=1e-6)
    np.testing.assert_allclose(found.floor_parts[STEPS], steps, rtol=1e-6)
    assert not found.lowers_floor(EMPTY), "once"


def test_a_floor_that_is_little_too_high_stays(tmp_path: Path) -> None:
    found = prepared(tmp_path, trial_of(tmp_path, POSITION, wave(300, 0.8)))
    high = raised(found, 1.2)
    assert not found.lowers_floor(EMPTY)
    assert found.problem.floor[0] == high


def test_the_floor_of_an_encoder_that_says_nothing_stays(tmp_path: Path) -> None:
    found = prepared(tmp_path, trial_of(tmp_path, POSITION, wave(300, 0.8)))
    raised(found, 10.0)
    found.problem.floor = np.array([1e6])
    assert not found.lowers_floor(EMPTY)
    assert found.problem.floor[0] == 1e6


def test_what_a_floor_too_high_hid_is_found_once_it_is_lowered(tmp_path: Path) -> None:
    """Damping leaves next to nothing of a floor of where the model ran to, a delay much of it."""
    model, *files = map(Path, case(tmp_path / "case", ("left",), viscous=0.3, delay=0.003))
    loaded = load_model(model)
    trials = read_trials(files, [], loaded.topics, loaded.realization.structure)
    found = prepare(loaded.realization, trials.fit, trials.held_out, threads=1)
    problem = found.problem
    measured = problem.floor.copy()
    hidden = raised(found, 20.0)
    best = search(found, trials, StepwiseSelection(problem)).selected.best
    assert {t.effect for t in best.hypothesis.terms} == {"viscous_friction", "command_delay"}
    assert float(np.sqrt(best.fitted.mean_square[0])) < measured[0] < 0.3 * hidden
    assert problem.floor[0] <= measured[0]
