"""Diagnoses of two pendulums with given effects, as ``pytest-twin diagnose`` writes them."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import load_written, write_realization
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.formats.mcap import read_recording, write_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import Trial, make_trial

sys.path.insert(0, str(Path(__file__).parents[1] / "diagnosis"))

from two_pendulums import DECLARED, mjcf, record

NOISE = 1e-3
"""Noise of the recorded positions, rad: two thirds of a count of an encoder with 12 bits."""
Effect = tuple[str, int, Mapping[str, float]]
"""Effect, joint, and parameters in SI units."""


@dataclass(frozen=True, slots=True)
class Robot:
    """Two pendulums and the motion that every case repeats."""

    model: Path
    trial: Trial
    prepared: PreparedProblem


def robot_in(folder: Path, *, seconds: float = 1.5) -> Robot:
    """Write the nominal model and one recording, and prepare the search for effects."""
    (folder / "model.xml").write_text(mjcf())
    realization = load_model(folder / "model.xml").realization
    path = record(folder / "motion.mcap", 4, seconds=seconds)
    trial = make_trial(read_recording(path), realization.structure)
    return Robot(folder / "model.xml", trial, prepare(realization, [trial], []))


def hypothesis(robot: Robot, effects: Sequence[Effect]) -> Hypothesis:
    """The effects as a hypothesis of a diagnosis."""
    scales = robot.prepared.problem.scales
    theta = [
        values[p.name] / scales.value(p, joint)
        for effect, joint, values in effects
        for p in catalogue()[effect].parameters
    ]
    return Hypothesis(tuple(Term(e, joint) for e, joint, _ in effects), np.array(theta))


def diagnosis_in(folder: Path, robot: Robot, effects: Sequence[Effect], **changed: Any) -> Path:
    """Write the diagnosis of a robot that has exactly these effects; return its folder.

    The held-out recording is what the patched model predicts, with noise.

    Args:
        changed: fields of ``diagnosis.json``.
    """
    found = hypothesis(robot, effects)
    out = folder / "diagnosis"
    (out / "realization").mkdir(parents=True)
    problem = robot.prepared.problem.at(found)
    nominal = load_model(robot.model).realization
    patched = write_realization(out / "realization", nominal, problem, found)
    recording = folder / "held_out.mcap"
    (predicted,) = replay_patched(load_written(out / "realization"), patched, [robot.trial])
    _record(recording, robot.trial, predicted.position)
    joints = robot.prepared.problem.joints
    document = {
        "schema": 1,
        "verdict": "explained",
        "findings": [
            {
                "effect": effect,
                "joint": None if joint < 0 else joints[joint],
                "confidence": 0.97,
                "parameters": {},
                "alternatives": [],
            }
            for effect, joint, _ in effects
        ],
        **changed,
    }
    (out / "diagnosis.json").write_text(json.dumps(document))
    assert find_model(out).is_file()
    return out


def _record(path: Path, trial: Trial, position: np.ndarray) -> None:
    series = read_recording(trial.path).series
    state = series["state"]
    order = [trial.joints.index(joint) for joint in state.names]
    noise = NOISE * np.random.default_rng(3).standard_normal(position.shape)
    measured = replace(state, position=(position + noise)[:, order])
    write_recording(path, [series["command"], measured], {**DECLARED, "role": "held_out"})
