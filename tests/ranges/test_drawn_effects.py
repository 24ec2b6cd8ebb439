"""A drawn robot moves like a twin whose effects are written with the drawn values."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "diagnosis"))

from two_pendulums import JOINTS, mjcf, record

from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.diagnosis.patched.write import write_realization
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.effects import catalogue
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.ranges.gather import collect_uncertain_parameters
from pytest_twin.ranges.ranges_of_twin import ranges_of_file
from pytest_twin.ranges.simulate import VariedRobots
from pytest_twin.realization import load
from pytest_twin.trial import Trial, make_trial
from pytest_twin.twin import load_twin

# Effect, joint, values in the twin, parameter that varies, and its drawn value; SI units.
DRAWN = [
    ("command_delay", 1, {"delay": 0.0213}, "delay", 0.035),
    ("rate_limit", 0, {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0},
     "inverse_rate", 1.6),
    ("encoder_bias", 1, {"bias": 0.05, "in_loop": 1.0}, "bias", 0.08),
    ("torque_constant", 0, {"relative_error": 0.25}, "relative_error", 0.4),
    ("controller_gain", 1, {"stiffness_error": 0.3, "damping_error": -0.2}, "stiffness_error", 0.6),
    ("torque_saturation", 0, {"inverse_limit": 1.0}, "inverse_limit", 1.5),
    ("torque_saturation", 0, {"inverse_limit": 1.0}, "inverse_limit", 0.8),
    ("torque_saturation", 1, {"inverse_limit": 0.5}, "inverse_limit", 1.5),
    ("torque_rolloff", 1, {"inverse_knee": 0.8, "back_emf": 0.05}, "inverse_knee", 1.2),
    ("motor_load_friction", 0,
     {"coefficient": 0.2, "stiction_excess": 0.1, "stribeck_velocity": 0.2}, "coefficient", 0.35),
    ("stribeck_friction", 0,
     {"coulomb": 0.1, "stiction_excess": 0.1, "stribeck_velocity": 0.2}, "coulomb", 0.2),
    ("armature", 1, {"inertia": 0.004}, "inertia", 0.007),
    ("joint_spring", 0, {"stiffness": 2.0, "preload": 0.3}, "stiffness", 3.0),
    ("gear_efficiency", 1, {"forward_loss": 0.2, "backward_loss": 0.6}, "forward_loss", 0.4),
]  # fmt: skip


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trial, PreparedProblem]:
    folder = tmp_path_factory.mktemp("bench")
    (folder / "model.xml").write_text(mjcf())
    realization = load_model(folder / "model.xml").realization
    path = record(folder / "a.mcap", 4, seconds=1.0)
    trial = make_trial(read_recording(path), realization.structure)
    return folder, trial, prepare(realization, [trial], [])


def written(bench: tuple, folder: Path, effect: str, joint: int, values: dict) -> Path:
    """Write a twin with an effect, and return the path of its ``twin.yaml``."""
    nominal, _, prepared = bench
    scales = prepared.problem.scales
    theta = [values[p.name] / scales.value(p, joint) for p in catalogue()[effect].parameters]
    found = Hypothesis((Term(effect, joint),), np.array(theta))
    (folder / "fit").mkdir(parents=True)
    realization = load_model(nominal / "model.xml").realization
    write_realization(folder / "fit", realization, prepared.problem, found)
    path = folder / "twin.yaml"
    path.write_text("model: fit\ncommand_between: held\n")
    return path


def with_record(path: Path, name: str, value: float, unit: str) -> None:
    record = {
        "schema": 1,
        "identification": "fitted",
        "verdict": "accepted",
        "stages": [{"stage": "drive", "state": "accepted"}],
        "parameters": {name: {"value": value, "unit": unit, "ci95": [value - 0.1, value + 0.1]}},
        "covariance": {"names": [name], "matrix": [[1e-4 * value**2]]},
        "held_out": {joint: {"position_rms": 0.1, "position_unit": "rad"} for joint in JOINTS},
        "trials": {"fit": ["a.mcap"], "held_out": ["b.mcap"]},
        "fit": {},
    }
    (path.parent / "record.json").write_text(json.dumps(record))
    path.write_text(path.read_text() + "fit:\n  - {file: record.json}\n")


@pytest.mark.parametrize(
    ("effect", "joint", "values", "parameter", "drawn"), DRAWN, ids=[one[0] for one in DRAWN]
)
def test_a_drawn_robot_moves_like_a_twin_with_the_drawn_value(
    bench: tuple, tmp_path: Path, effect: str, joint: int, values: dict, parameter: str,
    drawn: float, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    _, trial, _ = bench
    path = written(bench, tmp_path / "twin", effect, joint, values)
    (law,) = (one for one in catalogue()[effect].parameters if one.name == parameter)
    name = f"{JOINTS[joint]}.{effect}" + (f".{parameter}" if len(values) > 1 else "")
    with_record(path, name, values[parameter], law.fitted_unit("hinge"))
    twin = load_twin(path)
    robot = load(twin.first_realization.file, twin=twin)
    patched = read_patched_model(robot)
    found = collect_uncertain_parameters(twin, robot, patched)
    assert [one.name for one in found.distribution.coordinates] == [name], found.left_out
    (one,) = found.distribution.coordinates
    # What the time step adds is estimated at the twin's values, not at the drawn ones.
    monkeypatch.setattr(
        VariedRobots, "_correction", lambda self, segment, joints: np.zeros_like(segment.position)
    )
    fleet = VariedRobots(robot, patched, found.distribution.coordinates, found.bodies, 2**32)
    # A factor or a field of the model is drawn as a whole.
    own = 1.0 if law.relation == "relative" else 0.0
    own = one.mean - values[parameter] if one.field is not None else own
    (traces,) = fleet.simulate([trial], own + np.array([[values[parameter]], [drawn]]))
    motions = []
    for value in (values[parameter], drawn):
        other = written(
            bench, tmp_path / f"other{value}", effect, joint, {**values, parameter: value}
        )
        twin = load_twin(other)
        again = load(twin.first_realization.file, twin=twin)
        (of_other,) = VariedRobots(again, read_patched_model(again), (), (), 2**32).simulate(
            [trial], np.zeros((1, 0))
        )
        motions.append(of_other.robots[0])
    assert np.abs(motions[1] - motions[0]).max() > 1e-3, "the draw must change the motion"
    for robot_motion, motion in zip(traces.robots, motions, strict=True):
        assert np.abs(robot_motion - motion).max() < 2e-6


def test_correlated_delay_and_rate_limit_are_drawn_together(bench: tuple, tmp_path: Path) -> None:
    """A delay and a rate limit of one record keep their correlation in the robots."""
    limit = {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}
    path = written(bench, tmp_path / "twin", "rate_limit", 0, limit)
    effects = json.loads((path.parent / "fit/effects.json").read_text())
    effects["effects"].append(
        {"effect": "command_delay", "joint": JOINTS[0], "values": {"delay": 0.02},
         "in_model": False}
    )  # fmt: skip
    (path.parent / "fit/effects.json").write_text(json.dumps(effects))
    name = f"{JOINTS[0]}.rate_limit.inverse_rate"
    with_record(path, name, 1.0, "s/rad")
    document = json.loads((path.parent / "record.json").read_text())
    delay = f"{JOINTS[0]}.command_delay"
    document["parameters"][delay] = {"value": 0.02, "unit": "s", "ci95": [0.01, 0.03]}
    correlation = -0.8
    off = correlation * 0.05 * 0.002
    document["covariance"] = {
        "names": [name, delay],
        "matrix": [[0.05**2, off], [off, 0.002**2]],
    }
    (path.parent / "record.json").write_text(json.dumps(document))
    twin = load_twin(path)
    robot = load(twin.first_realization.file, twin=twin)
    found = collect_uncertain_parameters(twin, robot, read_patched_model(robot)).distribution
    columns = {one.name: k for k, one in enumerate(found.coordinates)}
    draws = found.draws(4000, 0)
    pair = draws[:, columns[name]], draws[:, columns[delay]]
    assert np.corrcoef(pair)[0, 1] == pytest.approx(correlation, abs=0.03)
    assert pair[1].std() == pytest.approx(0.002, rel=0.05)


@pytest.mark.parametrize(
    ("effect", "values", "parameter", "is_noted"),
    [
        ("rate_limit", {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0},
         "inverse_rate", True),
        ("command_delay", {"delay": 0.02}, "delay", False),
        ("armature", {"inertia": 0.004}, "inertia", False),
    ],
)  # fmt: skip
def test_what_no_configuration_of_a_simulator_sets_is_noted(
    bench: tuple, tmp_path: Path, effect: str, values: dict, parameter: str, is_noted: bool
) -> None:
    path = written(bench, tmp_path / "twin", effect, 0, values)
    (law,) = (one for one in catalogue()[effect].parameters if one.name == parameter)
    name = f"{JOINTS[0]}.{effect}" + (f".{parameter}" if len(values) > 1 else "")
    with_record(path, name, values[parameter], law.fitted_unit("hinge"))
    notes = ranges_of_file(str(path), {})["notes"]
    found = [note for note in notes if "only sampler.py has: " in note]
    assert [note.rpartition(": ")[2] for note in found] == ([name] if is_noted else [])


def test_a_parameter_that_the_recordings_do_not_determine_is_left_out_with_the_reason(
    bench: tuple, tmp_path: Path
) -> None:
    values = {"coulomb": 0.1, "stiction_excess": 0.0, "stribeck_velocity": 0.2}
    path = written(bench, tmp_path / "twin", "stribeck_friction", 0, values)
    drawn, kept = (
        f"{JOINTS[0]}.stribeck_friction.{name}" for name in ("coulomb", "stribeck_velocity")
    )
    with_record(path, drawn, 0.1, "N*m")
    record_file = path.parent / "record.json"
    text = json.loads(record_file.read_text())
    text["parameters"][kept] = {"value": 0.2, "unit": "rad/s", "ci95": [0.006, 6.0]}
    text["covariance"] = {"names": [drawn, kept], "matrix": [[1e-4, 0.0], [0.0, 0.0]]}
    record_file.write_text(json.dumps(text))
    twin = load_twin(path)
    robot = load(twin.first_realization.file, twin=twin)
    found = collect_uncertain_parameters(twin, robot, read_patched_model(robot))
    assert [one.name for one in found.distribution.coordinates] == [drawn]
    assert found.left_out == (f"{kept}: its recordings do not determine it, it keeps its value",)
