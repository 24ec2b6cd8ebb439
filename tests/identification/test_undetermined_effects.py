"""Effects that recordings of commands and positions can neither show nor exclude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_identify_simulation import MODEL, NOMINAL

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.signal_meaning import determine_signals
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.excitation.approved_limits import MECHANISMS
from pytest_twin.identification.motions import (
    undetermined_by_command,
    undetermined_by_effort,
)
from pytest_twin.identification.simulation.stage_effects import SIMULATED, StagePlan
from pytest_twin.identification.simulation.undetermined_terms import AbsentEffects
from pytest_twin.realization import load
from pytest_twin.recording_options import RecordingOptions
from pytest_twin.twin import DEFAULT_TOPICS


def undetermined(folder: Path, command: Callable[[float], float]) -> set[str]:
    """Undetermined effects of a pendulum that equals its model, driven by a command over time."""
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    data = mujoco.MjData(model)
    random = np.random.default_rng(1)
    rows = []
    for at in range(200):
        sent = command(at * 0.02)
        rows.append((at * 0.02, data.qpos[0] + 1e-3 * random.standard_normal(), sent))
        data.ctrl[0] = sent
        mujoco.mj_step(model, data, 4)
    path = folder / "one.csv"
    head = "time,swing.position,swing.command"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    robot = load(folder / "model.xml")
    options = RecordingOptions.from_json({"command_between": "held"})
    trials = read_trials([path], [], DEFAULT_TOPICS, robot.structure, options)
    setup = ModelSetup.of(robot, None, 1)
    used = determine_signals(setup, replace(trials, held_out=())).apply(trials)
    prepared, _ = build_problem(setup, used, [])
    absent = AbsentEffects.of(prepared.problem, EMPTY, StagePlan())
    return {term.effect for term in absent.undetermined()}


def test_a_small_slow_motion_leaves_delay_and_armature_undetermined(tmp_path: Path) -> None:
    slow = undetermined(tmp_path, lambda time: 0.02 * (1.0 - np.cos(2.0 * np.pi * 0.1 * time)))
    assert {"command_delay", "armature"} <= slow
    assert "encoder_bias" not in slow


def test_a_quick_and_large_motion_excludes_all_effects_that_a_stage_fits(tmp_path: Path) -> None:
    def quick(time: float) -> float:
        return float(sum(0.3 * np.sin(2.0 * np.pi * f * time + f) for f in (0.2, 0.5, 0.9, 1.5)))

    assert undetermined(tmp_path, quick) == set()


@pytest.mark.parametrize(
    ("stage", "place", "effect", "motion", "mechanism"),
    [
        ("delay", "swing", "command_delay", "quick steps of swing", "delay"),
        ("gravity", "robot", "payload", "gravity acts on the last link", "gravity"),
        ("friction", "swing", "coulomb_friction", "move swing slowly to and fro", "friction"),
    ],
)
def test_an_undetermined_effect_names_the_motion_that_would_determine_it(
    stage: str, place: str, effect: str, motion: str, mechanism: str
) -> None:
    entry = undetermined_by_command(stage, place, effect)  # type: ignore[arg-type]
    assert entry["expression"] == f"{place}.{effect}"
    assert motion in entry["motion"]
    assert entry["mechanism"] == mechanism


def test_every_missing_motion_is_one_that_excite_designs() -> None:
    for stage in SIMULATED:
        by_command = undetermined_by_command(stage, "swing", "an_effect")
        by_effort = undetermined_by_effort("Iyy1", stage, "swing", "Iyy")
        assert {by_command["mechanism"], by_effort["mechanism"]} <= set(MECHANISMS), stage
