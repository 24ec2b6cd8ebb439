"""A stage adds further effects only where they lower the held-out error."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from test_identify_simulation import MODEL, NOMINAL, REAL

from pytest_twin import cli
from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.signal_meaning import determine_signals
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis
from pytest_twin.identification.simulation import identify_by_simulation
from pytest_twin.identification.simulation.stage_effects import StagePlan, further_effects
from pytest_twin.identification.simulation.stage_fit import add_effects, held_out_error
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS

pytestmark = pytest.mark.usefixtures("commands_in_process")

STEPS = 80
"""Steps between two samples: the identification allows for the error of the model's own step."""
INTERVAL = 0.02 / STEPS
"""Step of the plant, s."""
DAMPING = 0.3
"""Damping of the servo, N*m*s/rad."""

Drive = Callable[[float, float], float]
"""(effort that the servo asks for in N*m, velocity in rad/s) -> delivered effort, N*m."""


def exact() -> Drive:
    return lambda effort, velocity: effort


def limited(limit: float) -> Drive:
    return lambda effort, velocity: min(max(effort, -limit), limit)


def with_dead_zone(width: float) -> Drive:
    return lambda effort, velocity: effort - min(max(effort, -width), width)


def limited_by_speed(stall: float, no_load_speed: float) -> Drive:
    """A motor at its supply voltage; the current is limited to that at stall, in braking too."""

    def drive(effort: float, velocity: float) -> float:
        used = velocity / no_load_speed
        most, least = stall * min(1.0 - used, 1.0), -stall * min(1.0 + used, 1.0)
        return min(max(effort, min(least, 0.0)), max(most, 0.0))

    return drive


def with_rolloff(knee: float) -> Drive:
    return lambda effort, velocity: effort / (1.0 + abs(effort) / knee)


def with_lag(time_constant: float) -> Drive:
    state = 0.0

    def drive(effort: float, velocity: float) -> float:
        nonlocal state
        state += (effort - state) * -np.expm1(-INTERVAL / time_constant)
        return state

    return drive


def write_trial(path: Path, seed: int, drive: Drive, robot: Mapping[str, float] = NOMINAL) -> Path:
    """Write a run of a pendulum whose servo drives it through a drive that the model lacks."""
    servo = f'<position name="servo" joint="swing" kp="{{kp}}" kv="{DAMPING}"/>'
    text = MODEL.replace(servo, '<motor name="servo" joint="swing"/>')
    assert text != MODEL
    model = mujoco.MjModel.from_xml_string(text.format(**robot))
    model.opt.timestep = INTERVAL
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    frequency, phase = random.uniform(0.2, 1.5, 4), random.uniform(0, 2 * np.pi, 4)
    rows = []
    for at in range(200):
        time = at * 0.02
        command = 0.3 * (np.sin(2 * np.pi * frequency * time + phase) - np.sin(phase)).sum()
        rows.append((time, data.qpos[0] + 1e-3 * random.standard_normal(), command))
        for _ in range(STEPS):
            position, velocity = float(data.qpos[0]), float(data.qvel[0])
            effort = robot["kp"] * (command - position) - DAMPING * velocity
            data.ctrl[0] = drive(effort, velocity)
            mujoco.mj_step(model, data)
    head = "time,swing.position,swing.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def found_by_the_drive_stage(
    folder: Path, drive: Callable[[], Drive]
) -> tuple[Problem, Hypothesis]:
    """The effects that the drive stage adds for recordings of a drive."""
    return found_by_a_stage(folder, drive, further_effects("drive"))


def found_by_a_stage(
    folder: Path, drive: Callable[[], Drive], effects: Sequence[str]
) -> tuple[Problem, Hypothesis]:
    """Those of the effects that a stage adds for recordings of a drive."""
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    *fit, held = (
        write_trial(folder / f"{name}.csv", seed, drive()) for seed, name in enumerate("abc", 1)
    )
    robot = load(folder / "model.xml")
    options = RecordingOptions.from_json({"command_between": "held"})
    trials = read_trials(fit, [held], DEFAULT_TOPICS, robot.structure, options)
    setup = ModelSetup.of(robot, None, 1)
    used = determine_signals(setup, trials).apply(trials)
    prepared, _ = build_problem(setup, used, [])
    problem = prepared.problem
    return problem, add_effects(problem, EMPTY, effects, ["position"])


def test_the_drive_stage_adds_nothing_where_the_drive_is_as_in_the_model(tmp_path: Path) -> None:
    _, found = found_by_the_drive_stage(tmp_path, exact)
    assert not found.terms


@pytest.mark.parametrize(
    ("drive", "effect", "parameter", "value"),
    [
        (partial(limited, 0.6), "torque_saturation", "limit", 0.6),
        (partial(limited, 1.0), "torque_saturation", "limit", 1.0),
        (partial(with_dead_zone, 0.15), "dead_zone", "width", 0.15 / NOMINAL["kp"]),
        (partial(limited_by_speed, 1.5, 3.0), "torque_speed_limit", "no_load_speed", 3.0),
        (partial(with_rolloff, 2.0), "torque_rolloff", "knee", 2.0),
        (partial(with_lag, 0.02), "actuator_lag", "time_constant", 0.02),
    ],
    ids=["limit 0.6", "limit 1.0", "dead zone", "speed limit", "roll-off", "lag"],
)
def test_the_drive_stage_adds_the_effect_that_the_drive_has(
    tmp_path: Path, drive: Callable[[], Drive], effect: str, parameter: str, value: float
) -> None:
    problem, found = found_by_the_drive_stage(tmp_path, drive)
    assert [term.effect for term in found.terms] == [effect]
    (term,) = found.terms
    theta = found.theta[found.slice_of(term)]
    reported = {
        p.reported_name: p.reported(float(x) * problem.scales.value(p, 0))
        for p, x in zip(term.parameters, theta, strict=True)
    }
    assert reported[parameter] == pytest.approx(value, rel=0.03)
    assert held_out_error(problem, found) < 1.2 < 0.25 * held_out_error(problem, EMPTY)


def test_friction_is_fitted_again_once_the_limit_of_the_drive_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the limit no friction explains the motion, and the friction stage comes first."""
    # The other stages find nothing here, and would take half of the time.
    two_stages = partial(
        identify_by_simulation.identify_simulation, plan=StagePlan(order=("friction", "drive"))
    )
    shown: list[float] = []

    def watched(*arguments: Any, progress: Callable[[float], None], **options: Any) -> Any:
        return two_stages(*arguments, progress=shown.append, **options)

    monkeypatch.setattr(identify_by_simulation, "identify_simulation", watched)
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    one, two, held = (
        str(write_trial(tmp_path / f"{name}.csv", seed, limited(1.0), REAL))
        for seed, name in enumerate("abc", 1)
    )
    words = ["identify", str(tmp_path / "model.xml"), one, two, "--held-out", held]
    assert cli.main([*words, "--command-between", "held", "--out", str(tmp_path / "out")]) == 0
    document = json.loads((tmp_path / "out/identification.json").read_text())
    stages = {stage["stage"]: stage for stage in document["stages"]}
    assert stages["friction"]["state"] == "reopened"
    assert "fitted again with what later stages had found" in stages["friction"]["why"]
    assert "the motion shows none of it" not in stages["friction"]["why"]
    assert stages["friction"]["parameters"] == ["swing.viscous_friction", "swing.coulomb_friction"]
    # Two stages, both together, and the two again.
    assert shown == pytest.approx([0.2, 0.4, 0.6, 0.6, 0.8])
    together = stages["closed_loop"]["held_out"]
    assert together["after"] < 1.0 < 0.2 * together["before"]
    found = {name: one["value"] for name, one in document["parameters"].items()}
    added = REAL["damping"] - NOMINAL["damping"]
    assert found["swing.viscous_friction"] == pytest.approx(added, abs=0.03)
    assert found["swing.coulomb_friction"] == pytest.approx(REAL["friction"], abs=0.03)
    gain = REAL["kp"] / NOMINAL["kp"] - 1.0
    assert found["swing.controller_gain.stiffness_error"] == pytest.approx(gain, abs=0.03)
