"""A stage adds further effects only where they lower the held-out error."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_identify_simulation import MODEL, NOMINAL

from pytest_twin.diagnosis.hypothesis import EMPTY
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.recorded import determine_signals
from pytest_twin.diagnosis.search_result import build_problem
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.identification.simulation.fitting import add_effects, held_out_error
from pytest_twin.identification.simulation.stage_effects import FURTHER
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS

STEPS = 80
"""Steps between two samples: the identification allows for the error of the model's own step."""


def write_trial(path: Path, seed: int, limit: float | None) -> Path:
    """Write a run of a pendulum whose servo has an effort limit (N*m) that the model lacks."""
    text = MODEL.format(**NOMINAL)
    if limit is not None:
        text = text.replace('kv="0.3"', f'kv="0.3" forcerange="-{limit} {limit}"')
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = 0.02 / STEPS
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.2, 1.5, 4), random.uniform(0, 2 * np.pi, 4)
    rows = []
    for at in range(200):
        time = at * 0.02
        command = 0.3 * (np.sin(2 * np.pi * frequency * time + phase) - np.sin(phase)).sum()
        rows.append((time, data.qpos[0] + 1e-3 * random.standard_normal(), command))
        data.ctrl[0] = command
        mujoco.mj_step(model, data, STEPS)
    head = "time,swing.position,swing.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


@pytest.mark.parametrize("limit", [0.6, 1.0, None])
def test_the_drive_stage_adds_a_limit_of_the_effort_where_the_drive_has_one(
    tmp_path: Path, limit: float | None
) -> None:
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    fit, held = (
        write_trial(tmp_path / f"{name}.csv", seed, limit) for seed, name in ((1, "a"), (2, "b"))
    )
    robot = load(tmp_path / "model.xml")
    options = RecordingOptions.from_json({"command_between": "held"})
    trials = read_trials([fit], [held], DEFAULT_TOPICS, robot.structure, options)
    given = ModelSetup.of(robot, None, 1)
    used = determine_signals(given, trials).applied(trials)
    prepared, _ = build_problem(given, used, [])
    problem = prepared.problem
    found = add_effects(problem, EMPTY, FURTHER["drive"], ["position"])
    if limit is None:
        assert not found.terms
        return
    (term,) = (one for one in found.terms if one.effect == "torque_saturation")
    (parameter,) = term.parameters
    theta = float(found.theta[found.slice_of(term)][0])
    value = parameter.reported(theta * problem.scales.value(parameter, 0))
    assert value == pytest.approx(limit, rel=0.1)
    assert held_out_error(problem, found) < 0.25 * held_out_error(problem, EMPTY)
