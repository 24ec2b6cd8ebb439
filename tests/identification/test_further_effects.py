"""The effects of drives that recordings of commands and positions show."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_identify_simulation import MODEL, NOMINAL, REAL

from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.identification.simulation.identify_by_simulation import (
    SimulationResult,
    identify_simulation,
)
from pytest_twin.identification.simulation.stage_effects import StagePlan, effects_of
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS

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


def identified(
    folder: Path,
    drive: Callable[[], Drive],
    robot: Mapping[str, float] = NOMINAL,
    plan: StagePlan | None = None,
) -> SimulationResult:
    """The identification from two runs of a drive, and a third one that is held out."""
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    *fit, held = (
        write_trial(folder / f"{name}.csv", seed, drive(), robot)
        for seed, name in enumerate("abc", 1)
    )
    model = load(folder / "model.xml")
    options = RecordingOptions.from_json({"command_between": "held"})
    trials = read_trials(fit, [held], DEFAULT_TOPICS, model.structure, options)
    return identify_simulation(model, trials, plan=plan)


def by_the_drive_stage(folder: Path, drive: Callable[[], Drive]) -> SimulationResult:
    """The identification of a drive alone."""
    plan = StagePlan(("drive",), dict.fromkeys(effects_of("drive"), "drive"))
    return identified(folder, drive, plan=plan)


def reported(result: SimulationResult) -> dict[str, float]:
    """Reported parameters, SI units."""
    problem, found = result.prepared.problem, result.hypothesis
    return {
        f"{term.effect}.{p.reported_name}": p.reported(
            float(x) * problem.scales.value(p, term.joint)
        )
        for term in found.terms
        for p, x in zip(term.parameters, found.theta[found.slice_of(term)], strict=True)
    }


def test_the_drive_stage_adds_nothing_where_the_drive_is_as_in_the_model(tmp_path: Path) -> None:
    assert not by_the_drive_stage(tmp_path, exact).hypothesis.terms


@pytest.mark.parametrize(
    ("drive", "effect", "parameter", "value"),
    [
        pytest.param(
            partial(limited, 0.6), "torque_saturation", "limit", 0.6, marks=pytest.mark.nightly
        ),
        (partial(limited, 1.0), "torque_saturation", "limit", 1.0),
        (partial(with_dead_zone, 0.15), "dead_zone", "width", 0.15 / NOMINAL["kp"]),
        pytest.param(
            partial(limited_by_speed, 1.5, 3.0),
            "torque_speed_limit",
            "no_load_speed",
            3.0,
            marks=pytest.mark.nightly,
        ),
        (partial(with_rolloff, 2.0), "torque_rolloff", "knee", 2.0),
        (partial(with_lag, 0.02), "actuator_lag", "time_constant", 0.02),
    ],
    ids=["limit 0.6", "limit 1.0", "dead zone", "speed limit", "roll-off", "lag"],
)
def test_the_drive_stage_adds_the_effect_that_the_drive_has(
    tmp_path: Path, drive: Callable[[], Drive], effect: str, parameter: str, value: float
) -> None:
    result = by_the_drive_stage(tmp_path, drive)
    assert [term.effect for term in result.hypothesis.terms] == [effect]
    assert reported(result)[f"{effect}.{parameter}"] == pytest.approx(value, rel=0.03)
    error = result.errors["swing"]
    assert error.after < 1.2 * error.floor < 0.3 * error.before


def test_friction_and_gain_are_found_beside_the_limit_of_the_drive(tmp_path: Path) -> None:
    """Without the limit no friction explains the motion."""
    result = identified(tmp_path, partial(limited, 1.0), REAL)
    stages = {stage.name: stage for stage in result.stages}
    assert {stages[name].state for name in ("friction", "drive", "closed_loop")} == {"accepted"}
    values = reported(result)
    added = REAL["damping"] - NOMINAL["damping"]
    assert values["viscous_friction.coefficient"] == pytest.approx(added, abs=0.03)
    assert values["coulomb_friction.coulomb"] == pytest.approx(REAL["friction"], abs=0.03)
    gain = REAL["kp"] / NOMINAL["kp"] - 1.0
    assert values["controller_gain.stiffness_error"] == pytest.approx(gain, abs=0.03)
    error = result.errors["swing"]
    assert error.after < error.floor < 0.01 * error.before
