"""True values lie in the intervals of an identification from commands and positions."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from nightly import samples
from test_identify_simulation import MODEL, NOMINAL

from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.identification.simulation.document import parameters_with_covariance
from pytest_twin.identification.simulation.identify_by_simulation import identify_simulation
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS

SERVO_DAMPING = 0.3
"""Of the model, N*m*s/rad."""
STEPS = 40
"""Steps of the plant between two samples."""


def write_trial(path: Path, seed: int, real: dict[str, float], servo_damping: float) -> Path:
    """Write a run of a pendulum whose servo and friction differ from the model's."""
    text = MODEL.format(**real).replace('kv="0.3"', f'kv="{servo_damping}"')
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = 0.02 / STEPS
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.2, 1.5, 4), random.uniform(0, 2 * np.pi, 4)
    rows = []
    for at in range(250):
        time = at * 0.02
        command = 0.3 * (np.sin(2 * np.pi * frequency * time + phase) - np.sin(phase)).sum()
        rows.append((time, data.qpos[0] + 5e-4 * random.standard_normal(), command))
        data.ctrl[0] = command
        mujoco.mj_step(model, data, STEPS)
    head = "time,swing.position,swing.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def missed(folder: Path, seed: int) -> tuple[int, list[str]]:
    """Number of parameters of a drawn pendulum, and those whose interval lacks the true value."""
    random = np.random.default_rng(100 + seed)
    real = {
        "damping": NOMINAL["damping"] + random.uniform(0.0, 0.4),
        "friction": random.uniform(0.05, 0.3),
        "kp": NOMINAL["kp"] * random.uniform(0.7, 1.3),
    }
    servo_damping = SERVO_DAMPING * random.uniform(0.5, 2.0)
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    robot = load(folder / "model.xml")
    one, two, held = (
        write_trial(folder / f"{k}.csv", 3 * seed + k, real, servo_damping) for k in range(3)
    )
    options = RecordingOptions.from_json({"command_between": "held"})
    trials = read_trials([one, two], [held], DEFAULT_TOPICS, robot.structure, options)
    parameters, _ = parameters_with_covariance(identify_simulation(robot, trials))
    true = {
        "swing.viscous_friction": real["damping"] - NOMINAL["damping"],
        "swing.coulomb_friction": real["friction"],
        "swing.controller_gain.stiffness_error": real["kp"] / NOMINAL["kp"] - 1.0,
        "swing.controller_gain.damping_error": servo_damping / SERVO_DAMPING - 1.0,
    }
    # An effect that the plant does not have is at zero.
    outside = [
        name
        for name, estimate in parameters.items()
        if not estimate["ci95"][0] <= true.get(name, 0.0) <= estimate["ci95"][1]
    ]
    return len(parameters), outside


@pytest.mark.parametrize("seeds", samples(12, always=(0, 1)))
def test_intervals_of_servo_and_friction_contain_the_true_values(
    tmp_path: Path, seeds: tuple[int, ...]
) -> None:
    count, outside = 0, list[str]()
    for seed in seeds:
        folder = tmp_path / str(seed)
        folder.mkdir()
        parameters, names = missed(folder, seed)
        count += parameters
        outside += names
    assert count >= 2 * len(seeds)
    # 95 % intervals: of few parameters none is outside, of many one in ten.
    assert len(outside) <= 0.1 * count, outside
