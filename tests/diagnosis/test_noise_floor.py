"""The noise floor: initial states, effort sensors, sample timing and discretization error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from searched import ProblemPhysics, searched
from two_pendulums import START_NS, case

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.noise import timing_noise
from pytest_twin.diagnosis.prepare import NOISE as SENSOR
from pytest_twin.diagnosis.prepare import STEP as STEPS
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import Trial, make_trial

STEP, TICK, SECONDS, NOISE = 0.001, 0.01, 2.0, 3e-4


def mjcf(drive: str) -> str:
    return (
        f'<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>'
        '<inertial pos="0 0 -0.2" mass="1" diaginertia="0.002 0.002 0.002"/>'
        '<joint name="j" axis="0 -1 0" armature="0.01" damping="0.1"/></body></worldbody>'
        f"<actuator>{drive}</actuator></mujoco>"
    )


VELOCITY = '<velocity name="j" joint="j" kv="4"/>'
POSITION = '<position name="j" joint="j" kp="200" kv="6"/>'


def simulate(drive: str, command: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Simulate commands (ticks,): stamps in s, positions in rad, efforts in N*m, every 10 ms."""
    model = mujoco.MjModel.from_xml_string(mjcf(drive))
    data = mujoco.MjData(model)
    each = round(TICK / STEP)
    time, position, effort = np.empty((3, len(command) * each))
    for k in range(len(time)):
        data.ctrl[0] = command[k // each]
        mujoco.mj_forward(model, data)
        time[k], position[k], effort[k] = data.time, data.qpos[0], data.qfrc_actuator[0]
        mujoco.mj_step(model, data)
    # Sensor samples are not simultaneous with commands.
    return time[4::each], position[4::each], effort[4::each]


def trial_of(
    folder: Path, drive: str, command: FloatArray, *, first: float = 0.0, noise: float = NOISE
) -> Trial:
    """A recording of the simulation; ``first`` is the error of its first position in ``noise``."""
    time, position, effort = simulate(drive, command)
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


def prepared(folder: Path, trial: Trial) -> PreparedProblem:
    return prepare(load_model(folder / "model.xml").realization, [trial], [], threads=1)


def wave(ticks: int, size: float) -> FloatArray:
    t: FloatArray = TICK * np.arange(ticks, dtype=np.float64)
    return np.asarray(size * np.sin(2.0 * np.pi * 0.7 * t) * np.minimum(t / 0.3, 1.0))


def test_an_error_of_the_first_position_under_a_velocity_servo_is_no_model_error(
    tmp_path: Path,
) -> None:
    """The servo keeps the error of the first reading for the whole recording."""
    trial = trial_of(tmp_path, VELOCITY, wave(300, 0.8), first=5.0)
    problem = prepared(tmp_path, trial).problem
    residual = problem.residuals([EMPTY], problem.fit)[0][:, 0]
    assert np.sqrt(np.mean(residual**2)) < 1.2 * problem.floor[0]
    kept = replace(problem, starts={}).residuals([EMPTY], problem.fit)[0][:, 0]
    assert np.sqrt(np.mean(kept**2)) > 2.0 * problem.floor[0]


def test_the_free_initial_position_is_limited_by_the_samples_around_the_start(
    tmp_path: Path,
) -> None:
    """A shift of 100 standard deviations contradicts the samples around the start."""
    trial = trial_of(tmp_path, VELOCITY, wave(300, 0.8))
    shifted = replace(trial, position=trial.position + 100.0 * NOISE)
    shifted.position[0] = trial.position[0]
    problem = prepared(tmp_path, shifted).problem
    residual = problem.residuals([EMPTY], problem.fit)[0][:, 0]
    assert np.sqrt(np.mean(residual**2)) > 10.0 * problem.floor[0]


@pytest.mark.parametrize(
    ("unsigned", "is_used"), [(False, True), (True, False)], ids=["signed", "unsigned"]
)
def test_an_effort_without_sign_is_not_used(tmp_path: Path, unsigned: bool, is_used: bool) -> None:
    trial = trial_of(tmp_path, POSITION, wave(300, 0.8))
    assert trial.effort is not None
    if unsigned:
        trial = replace(trial, effort=np.abs(trial.effort))
    assert (prepared(tmp_path, trial).problem.effort_floor is not None) is is_used


def test_an_effort_of_one_sign_is_used_if_the_model_has_the_same_sign(tmp_path: Path) -> None:
    """The servo holds the arm against gravity on one side."""
    trial = trial_of(tmp_path, POSITION, 0.9 + wave(300, 0.02))
    trial = replace(trial, **{n: getattr(trial, n)[100:] for n in ("time", "position", "effort")})
    assert trial.effort is not None
    assert trial.effort.min() > 0.0
    trial = replace(trial, time=trial.time - trial.time[0], command_time=trial.command_time - 1.0)
    assert prepared(tmp_path, trial).problem.effort_floor is not None


def test_effort_jumps_of_a_stiff_servo_are_not_counted_as_sensor_noise(tmp_path: Path) -> None:
    """The effort jumps at every command; the noise floor has the size of the sensor noise."""
    steps = np.repeat(np.random.default_rng(1).uniform(-0.2, 0.2, 100), 3)
    trial = trial_of(tmp_path, POSITION, steps)
    floor = prepared(tmp_path, trial).problem.effort_floor
    assert floor is not None
    assert trial.effort is not None
    jumps = np.abs(np.diff(trial.effort[:, 0])).max()
    assert 0.015 < floor[0] < 0.05 * jumps


@pytest.mark.parametrize(("scale", "is_detected"), [(1.0, False), (0.8, True)])
def test_a_scale_error_of_efforts_is_detected_between_jumps(
    tmp_path: Path, scale: float, is_detected: bool
) -> None:
    """Samples close to jumps have little weight; those between them reveal an error of 20 %."""
    steps = np.repeat(np.random.default_rng(1).uniform(-0.2, 0.2, 30), 10)
    trial = trial_of(tmp_path, POSITION, steps)
    assert trial.effort is not None
    problem = prepared(tmp_path, replace(trial, effort=scale * trial.effort)).problem
    assert problem.effort_floor is not None
    off = problem.residuals([EMPTY], problem.fit)[0][:, 1]
    level = float(np.sqrt(np.mean(off**2))) / problem.effort_floor[0]
    assert bool(level > 2.0) is is_detected, level
    # Effects of effort sensors are simulated until they are in the fit.
    floor = problem.effort_floor * level / (1.6 if is_detected else 1.4)
    problem = replace(problem, effort_floor=floor)
    physics = ProblemPhysics(problem)
    mean_square = np.mean(problem.residuals([EMPTY], problem.fit)[0] ** 2, axis=0)
    starts = physics.sensor_effects(EMPTY, mean_square)
    effects = {h.terms[-1].effect for h in starts}
    assert effects == ({"effort_scale", "effort_bias"} if is_detected else set())
    for start in starts:
        others = [h.terms for h in physics.sensor_effects(start, mean_square)]
        assert [t[-1].effect for t in others] == [*(effects - {start.terms[-1].effect})]


def test_an_effort_sample_in_the_time_step_of_a_command_jump_has_no_weight(tmp_path: Path) -> None:
    """The drive of the model receives a mean of both commands, and the sensor measured one of them.
    If the drive is saturated, a finer time step does not change this.
    """
    limited = POSITION.replace("/>", ' forcerange="-4 4"/>')
    trial = trial_of(tmp_path, limited, np.repeat([0.0, 0.3, -0.1], 100))

    def weights(sampled: float, sent: float) -> FloatArray:
        """Weights with samples and commands this many time steps after each tick."""
        moved_on = replace(
            trial,
            time=trial.time + (sampled - 4.0) * STEP,
            command_time=trial.command_time + sent * STEP,
        )
        (found,) = prepared(tmp_path, moved_on).problem.effort_weights.values()
        return found[:, 0]

    # Sample 100 is the first one under the second command.
    for sampled, sent in ((4.0, 4.3), (4.2, 4.3), (4.6, 4.3), (4.7, 4.6)):
        found = weights(sampled, sent)
        assert (found[[100, 200]] < 0.01).all(), found[[100, 200]]
        # All other commands equal the preceding one.
        assert (np.delete(found, [100, 200]) > 0.5).mean() > 0.9


def test_the_timing_noise_is_at_most_the_sensor_noise(tmp_path: Path) -> None:
    """The joint moves slowly, then fast: the mean timing noise is above that of most samples."""
    t = TICK * np.arange(300)
    command = 0.3 * np.sin(2.0 * np.pi * 0.3 * t) + 0.6 * np.sin(20.0 * t) * (t > 2.2)
    trial = trial_of(tmp_path, POSITION, command, noise=1e-6)
    late = 2e-3 * np.random.default_rng(0).uniform(-1.0, 1.0, len(trial.time))
    late[0] = 0.0
    trial = replace(trial, time=trial.time + late)
    found = prepared(tmp_path, trial)
    usual, timing, _ = found.floor_parts.values()
    everywhere = timing_noise(found.problem.simulator.segments, [0])
    assert everywhere[0] > 1.5 * usual[0], "the timing noise must exceed the limit"
    assert timing[0] == usual[0]


def with_raised_floor(found: PreparedProblem, times: float) -> PreparedProblem:
    """The problem with a floor for a discretization error of ``times`` the sensor noise."""
    sensor, share = found.floor_parts[SENSOR], found.problem.step_left
    steps = times * sensor / share
    return replace(
        found,
        problem=replace(found.problem, floor=np.hypot(sensor, share * steps)),
        floor_parts=found.floor_parts | {STEPS: steps},
    )


def test_the_floor_of_a_diverging_nominal_model_is_lowered_at_the_found_model(
    tmp_path: Path,
) -> None:
    found = prepared(tmp_path, trial_of(tmp_path, POSITION, wave(300, 0.8)))
    high = with_raised_floor(found, 10.0)
    lower = high.with_lower_floor(EMPTY)
    assert lower is not None
    np.testing.assert_allclose(lower.problem.floor, found.problem.floor, rtol=1e-6)
    np.testing.assert_allclose(lower.floor_parts[STEPS], found.floor_parts[STEPS], rtol=1e-6)
    assert lower.with_lower_floor(EMPTY) is None, "the floor must be lowered once only"


def test_a_floor_that_is_slightly_too_high_is_kept(tmp_path: Path) -> None:
    found = prepared(tmp_path, trial_of(tmp_path, POSITION, wave(300, 0.8)))
    assert with_raised_floor(found, 1.2).with_lower_floor(EMPTY) is None


def test_the_floor_of_a_stuck_encoder_is_kept(tmp_path: Path) -> None:
    found = prepared(tmp_path, trial_of(tmp_path, POSITION, wave(300, 0.8)))
    high = with_raised_floor(found, 10.0)
    stuck = replace(high, problem=replace(high.problem, floor=np.array([1e6])))
    assert stuck.with_lower_floor(EMPTY) is None


def test_an_effect_below_a_floor_that_was_too_high_is_found_after_the_floor_is_lowered(
    tmp_path: Path,
) -> None:
    """With viscous friction in the model the floor is lowered, and the delay exceeds it.

    The delay is 12 ms, because a lag explains these recordings as well as a delay of 8 ms.
    """
    model, *files = map(Path, case(tmp_path / "case", ("left",), viscous=0.3, delay=0.012))
    loaded = load_model(model)
    trials = read_trials(files, [], loaded.topics, loaded.realization.structure)
    found = prepare(loaded.realization, trials.fit, trials.held_out, threads=1)
    measured = found.problem.floor
    raised = with_raised_floor(found, 40.0)
    hidden = raised.problem.floor[0]
    first = searched(raised.problem).incumbent
    lower = raised.with_lower_floor(first.hypothesis)
    assert lower is not None
    best = searched(lower.problem, first.hypothesis).incumbent
    assert {t.effect for t in best.hypothesis.terms} == {"viscous_friction", "command_delay"}
    assert float(np.sqrt(best.mean_square[0])) < measured[0] < 0.3 * hidden
    assert lower.problem.floor[0] <= measured[0]
