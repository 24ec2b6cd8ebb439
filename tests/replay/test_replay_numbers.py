"""Numerical accuracy of the replay: closed forms, plain mj_step loops, smaller steps."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from replay_trials import ARM, model, slider, trial

from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.trial import Trial
from pytest_twin.twin import JointCalibration

MASS, STIFFNESS, DAMPING = 2.0, 300.0, 12.0
SERVO = f'<position joint="x" kp="{STIFFNESS}" kv="{DAMPING}"/>'


def held_oscillator(
    time: np.ndarray, start: float, speed: float, command_time: np.ndarray, command: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Position (m) and velocity (m/s) of ``m x'' = k (u - x) - d x'`` with u held between stamps.

    Between two stamps ``x - u`` is a damped oscillation in closed form.
    """
    decay = DAMPING / (2 * MASS)
    omega = np.sqrt(STIFFNESS / MASS - decay**2)

    def after(dt: np.ndarray | float, x: float, v: float, u: float) -> tuple[object, object]:
        a, b = x - u, (v + decay * (x - u)) / omega
        e, c, s = np.exp(-decay * dt), np.cos(omega * dt), np.sin(omega * dt)
        return u + e * (a * c + b * s), e * (
            (b * omega - a * decay) * c - (a * omega + b * decay) * s
        )

    position, velocity = np.empty_like(time), np.empty_like(time)
    x, v, at = start, speed, 0.0
    edges = [t for t in command_time if t > 0.0] + [np.inf]
    held = float(command[max(np.searchsorted(command_time, 0.0, side="right") - 1, 0)])
    for edge in edges:
        here = (time >= at) & (time < edge)
        position[here], velocity[here] = after(time[here] - at, x, v, held)
        if np.isfinite(edge):
            x, v = after(edge - at, x, v, held)
            at, held = edge, float(command[np.searchsorted(command_time, edge, side="right") - 1])
    return position, velocity


def irregular_stamps(rng: np.random.Generator, end: float, mean: float) -> np.ndarray:
    steps = rng.uniform(0.3, 1.7, round(end / mean)) * mean
    return np.concatenate([[0.0], np.cumsum(steps)]).round(9)


def test_a_position_servo_on_a_mass_matches_the_closed_form() -> None:
    rng = np.random.default_rng(1)
    time = irregular_stamps(rng, 2.0, 0.007)
    command_time = (irregular_stamps(rng, 2.0, 0.02) / 1e-3).round() * 1e-3 - 0.005
    command = np.cumsum(rng.normal(0, 0.1, len(command_time)))
    made = trial(time, 0.3, command_time, command, velocity=-0.8)
    (result,) = replay_rows([Row(made, model(slider(SERVO)))])
    position, velocity = held_oscillator(time, 0.3, -0.8, made.command_time, command)
    # Commands arrive on steps: only integration and cubic interpolation errors remain.
    assert np.abs(result.position[:, 0] - position).max() < 2e-8
    assert np.abs(result.velocity[:, 0] - velocity).max() < 1e-4
    # The effort belongs to the step that contains the stamp. MuJoCo's RK4 reports the effort of
    # its last stage, at the end of the step.
    begin = np.floor(time / 1e-3 + 1e-5) * 1e-3
    end, speed = held_oscillator(begin + 1e-3 - 1e-9, 0.3, -0.8, made.command_time, command)
    held = command[np.searchsorted(made.command_time, begin + 1e-9) - 1]
    force = STIFFNESS * (held - end) - DAMPING * speed
    assert np.abs(result.effort[:, 0] - force).max() < 1e-3 * np.abs(force).max()


def test_commands_between_steps_keep_second_order_accuracy() -> None:
    rng = np.random.default_rng(2)
    time = irregular_stamps(rng, 2.0, 0.007)
    command_time = irregular_stamps(rng, 2.0, 0.0203)
    command = np.cumsum(rng.normal(0, 0.1, len(command_time)))
    made = trial(time, 0.0, command_time, command)
    errors = []
    for timestep in (4e-3, 2e-3, 1e-3):
        (result,) = replay_rows([Row(made, model(slider(SERVO, timestep=timestep)))])
        position, _ = held_oscillator(time, 0.0, 0.0, made.command_time, command)
        errors.append(np.abs(result.position[:, 0] - position).max())
    assert errors[2] < 3e-5
    # A command applied at the next step would reduce the order from two to one.
    assert errors[0] / errors[1] > 3.0
    assert errors[1] / errors[2] > 3.0


def trial_on_steps(timestep: float, seed: int = 3) -> Trial:
    """A trial of 2 s on the arm with all stamps on multiples of ``timestep``."""
    rng = np.random.default_rng(seed)
    command_time = np.sort(rng.choice(1000, 60, replace=False)) * timestep
    command = 0.5 * rng.standard_normal((60, 2))
    time = np.concatenate([[0], np.sort(rng.choice(np.arange(1, 1000), 200, replace=False))])
    return trial(time * timestep, (0.2, -0.4), command_time, command, joints=("shoulder", "elbow"))


def mj_step_loop(arm: mujoco.MjModel, made: Trial) -> np.ndarray:
    data = mujoco.MjData(arm)
    data.qpos[:] = made.position[0]
    rows = []
    steps = np.rint(made.time / arm.opt.timestep).astype(int)
    command_steps = np.rint(made.command_time / arm.opt.timestep).astype(int)
    for step in range(steps[-1] + 1):
        rows.append(data.qpos.copy())
        data.ctrl[:] = made.command[max(np.searchsorted(command_steps, step, side="right") - 1, 0)]
        mujoco.mj_step(arm, data)
    return np.array(rows)[steps]


@pytest.mark.parametrize("threads", [1, 2])
def test_replay_is_bitwise_equal_to_a_loop_of_mj_step(threads: int) -> None:
    arm = model(ARM)
    trials = [trial_on_steps(0.002, seed) for seed in range(5)]
    results = replay_rows([Row(made, arm) for made in trials], threads=threads)
    for made, result in zip(trials, results, strict=True):
        assert np.array_equal(result.position, mj_step_loop(arm, made))


def test_rows_of_different_length_and_model_are_independent() -> None:
    arm, heavy = model(ARM), model(ARM.replace('mass="0.5"', 'mass="1.5"'))
    long, short = trial_on_steps(0.002, 7), trial_on_steps(0.002, 8)
    short = trial(
        short.time[:40], short.position[0], short.command_time, short.command, joints=short.joints
    )
    rows = [Row(long, arm), Row(short, heavy), Row(long, heavy), Row(short, arm)]
    together = replay_rows(rows)
    for row, result in zip(rows, together, strict=True):
        assert np.array_equal(result.position, replay_rows([row])[0].position)
        assert np.array_equal(result.position, mj_step_loop(row.model, row.trial))
    assert not np.array_equal(together[0].position, together[2].position)


def test_replay_converges_with_smaller_steps() -> None:
    made = trial_on_steps(0.002, 11)
    fine = replay_rows([Row(made, model(ARM.replace('"0.002"', '"0.00003125"')))])[0]
    errors = [
        np.abs(
            replay_rows([Row(made, model(ARM.replace('"0.002"', f'"{step}"')))])[0].position
            - fine.position
        ).max()
        for step in (0.002, 0.001, 0.0005)
    ]
    assert errors[0] < 0.02
    assert errors[2] < 0.5 * errors[1] < 0.3 * errors[0]


def test_joint_calibration_converts_inputs_and_predictions() -> None:
    arm, made = model(ARM), trial_on_steps(0.002, 13)
    sign, offset = np.array([-1.0, 1.0]), np.array([0.3, -0.1])
    # model = sign * measured + offset
    measured = trial(
        made.time, sign * (made.position[0] - offset), made.command_time,
        sign * (made.command - offset), joints=made.joints,
    )  # fmt: skip
    calibration = {
        joint: JointCalibration(o, s) for joint, o, s in zip(made.joints, offset, sign, strict=True)
    }
    (plain,), (calibrated,) = (
        replay_rows([Row(made, arm)]),
        replay_rows([Row(measured, arm, calibration)]),
    )
    assert np.allclose(calibrated.qpos, plain.qpos, atol=1e-9)
    assert np.allclose(calibrated.position, sign * (plain.position - offset), atol=1e-9)
    assert np.allclose(calibrated.velocity, sign * plain.velocity, atol=1e-7)
    assert np.allclose(calibrated.effort, sign * plain.effort, atol=1e-5)


def test_an_effort_command_acts_on_a_joint_without_actuator() -> None:
    time, command_time = np.arange(0, 0.5, 0.01), np.array([0.0, 0.2])
    made = trial(time, 0.1, command_time, np.array([4.0, -2.0]), mode="effort")
    (result,) = replay_rows([Row(made, model(slider("")))])
    early = time <= 0.2
    rest = time - 0.2
    position = np.where(
        early, 0.1 + time**2, 0.1 + 0.04 + 0.4 * rest - 0.5 * rest**2
    )  # 4 N on 2 kg, then -2 N
    assert np.abs(result.position[:, 0] - position).max() < 1e-12
    assert result.effort[3, 0] == 4.0
    assert result.effort[-1, 0] == -2.0


def test_a_diverging_trial_names_joint_and_time_and_does_not_affect_others() -> None:
    unstable = slider('<position joint="x" kp="1e9" kv="0"/>', mass=1e-3).replace("RK4", "Euler")
    time = np.arange(0, 3.0, 0.01)
    made = trial(time, 0.0, np.array([0.0, 1.0]), np.array([0.0, 0.5]))
    good = model(slider(SERVO))
    bad, fine = replay_rows([Row(made, model(unstable)), Row(made, good)])
    assert bad.error is not None
    assert bad.error.where == "joint 'x'"
    words = "joint 'x': the acceleration diverged 1 s after the first state of made.mcap"
    next_step = "a stable simulation; check timestep, inertias and servo gains"
    assert str(bad.error) == f"{words} (expected {next_step})"
    assert np.array_equal(bad.position[:100, 0], np.zeros(100))
    assert np.isnan(bad.position[100:, 0]).all()
    assert fine.error is None
    assert np.array_equal(fine.position, replay_rows([Row(made, good)])[0].position)


def test_mujoco_warnings_write_no_log_file(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(str(tmp_path))
    unstable = slider('<position joint="x" kp="1e9" kv="0"/>', mass=1e-3).replace("RK4", "Euler")
    made = trial(np.arange(0, 1.0, 0.01), 1.0, np.array([0.0]), np.array([0.0]))
    (bad,) = replay_rows([Row(made, model(unstable))])
    assert bad.error is not None
    assert list(tmp_path.iterdir()) == []  # type: ignore[attr-defined]
    assert capfd.readouterr() == ("", "")
