"""Effects written into MJCF predict the motion of the diagnosis; replay adds the others."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_first_order import carried, link
from two_pendulums import JOINTS, mjcf, record

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.model import read_effects
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import write_realization
from pytest_twin.diagnosis.prepare import PreparedProblem, prepare
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.effects import catalogue
from pytest_twin.errors import SpecError
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import Trial, make_trial
from pytest_twin.twin import EFFECTS_FILE

# Effect, joint, parameters in SI units, and whether plain MJCF represents it completely.
EFFECTS = [
    ("viscous_friction", 0, {"coefficient": 0.1}, True),
    ("viscous_friction", 0, {"coefficient": -0.2}, False),
    ("coulomb_friction", 1, {"coulomb": 0.1}, True),
    ("asymmetric_friction", 0, {"coulomb": 0.1, "offset": 0.05}, False),
    ("quadratic_drag", 0, {"coefficient": 0.05}, True),
    ("armature", 1, {"inertia": 0.004}, True),
    ("joint_spring", 0, {"stiffness": 2.0, "preload": 0.3}, True),
    ("joint_spring", 0, {"stiffness": -0.5, "preload": 0.3}, False),
    ("controller_gain", 1, {"stiffness_error": 0.3, "damping_error": -0.2}, True),
    ("torque_constant", 0, {"relative_error": 0.25}, True),
    ("torque_saturation", 0, {"inverse_limit": 1.0}, True),
    ("command_delay", 1, {"delay": 0.0213}, True),
    ("actuator_lag", 0, {"time_constant": 0.03, "of_setpoint": 1.0}, True),
    ("actuator_lag", 1, {"time_constant": 0.003, "of_setpoint": 1.0}, True),
    ("actuator_lag", 1, {"time_constant": 0.03, "of_setpoint": 0.0}, False),
    ("inertial_parameters", 0, link(0, relative_error=0.4), True),
    ("inertial_parameters", 1, link(1, mass_error=0.5), True),
    ("inertial_parameters", 1, link(2, inertia_error=3.0), True),
    (
        "inertial_parameters",
        1,
        link(3, mass_error=0.2, inertia_error=-0.3, radial=0.03, tangential=-0.04),
        True,
    ),
    ("payload", -1, carried(0.2, 0.15), True),
    ("payload", -1, carried(-0.2, 0.1), True),
    ("payload", -1, carried(0.2, 0.1, 0.12), True),
    ("payload", -1, carried(0.2, 0.1, 0.12, 0.05), True),
    ("base_tilt", -1, {"roll": 0.05, "pitch": -0.1}, True),
    ("rate_limit", 0, {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}, False),
    ("rate_limit", 1, {"inverse_rate": 0.0, "inverse_effort_rate": 0.05, "of_effort": 1.0}, False),
    ("torque_rolloff", 1, {"inverse_knee": 0.8, "back_emf": 0.05}, False),
    ("watchdog_timeout", 0, {"inverse_timeout": 140.0, "back_emf": 0.05}, False),
    (
        "motor_load_friction",
        0,
        {"coefficient": 0.2, "stiction_excess": 0.1, "stribeck_velocity": 0.2},
        False,
    ),
    ("control_period", 0, {"period": 0.0083, "computing_delay": 0.7}, False),
    ("velocity_filter", 1, {"time_constant": 0.01}, False),
    ("velocity_feedforward", 0, {"feedforward": 0.08}, False),
    ("integral_gain", 1, {"inverse_integral_time": 1.5}, False),
    ("directional_viscous_friction", 0, {"coefficient": 0.1, "difference": 0.04}, False),
    ("gear_efficiency", 1, {"forward_loss": 0.2, "backward_loss": 0.6}, False),
    ("encoder_bias", 1, {"bias": 0.05, "in_loop": 1.0}, False),
    ("sensor_delay", -1, {"delay": 0.013}, False),
]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Trial, PreparedProblem]:
    folder = tmp_path_factory.mktemp("bench")
    (folder / "model.xml").write_text(mjcf())
    realization = load_model(folder / "model.xml").realization
    path = record(folder / "a.mcap", 4, seconds=1.0)
    trial = make_trial(read_recording(path), realization.structure)
    return folder, trial, prepare(realization, [trial], [])


def hypothesis(
    prepared: PreparedProblem, effect: str, joint: int, values: dict[str, float]
) -> Hypothesis:
    scales = prepared.problem.scales
    theta = [values[p.name] / scales.value(p, joint) for p in catalogue()[effect].parameters]
    return Hypothesis((Term(effect, joint),), np.array(theta))


@pytest.mark.parametrize(
    ("effect", "joint", "values", "native"),
    EFFECTS,
    ids=[f"{effect} in {'MJCF' if native else 'replay'}" for effect, _, _, native in EFFECTS],
)
def test_the_written_model_predicts_the_same_motion_as_the_effect(
    bench: tuple[Path, Trial, PreparedProblem],
    tmp_path: Path,
    effect: str,
    joint: int,
    values: dict[str, float],
    native: bool,
) -> None:
    folder, trial, prepared = bench
    problem = prepared.problem
    found = hypothesis(prepared, effect, joint, values)
    (nominal,) = problem.predict([EMPTY], np.array([0]))
    problem = problem.at(found)
    (expected,) = problem.predict([found], np.array([0]))
    out = tmp_path / "realization"
    out.mkdir()
    patched = write_realization(out, load_model(folder / "model.xml").realization, problem, found)
    assert (patched.outside_mjcf == ()) is native
    loaded = load_model(find_model(tmp_path))
    assert loaded.patched is not None
    (written,) = replay_patched(loaded.realization, loaded.patched, [trial])
    difference = np.abs(written.position - expected[0].position).max()
    moved = np.abs(expected[0].position - nominal[0].position).max()
    assert moved > 1e-3, "the effect must change the motion, or every model would pass"
    assert difference < 0.01 * moved
    assert difference < 2e-4
    mujoco.MjModel.from_xml_path(str(out / "model.xml"))


def test_several_effects_on_one_actuator_are_written_together(
    bench: tuple[Path, Trial, PreparedProblem], tmp_path: Path
) -> None:
    folder, trial, prepared = bench
    parts = [
        hypothesis(prepared, "controller_gain", 0, {"stiffness_error": 0.3, "damping_error": 0.1}),
        hypothesis(prepared, "torque_constant", 0, {"relative_error": -0.2}),
        hypothesis(prepared, "command_delay", 0, {"delay": 0.01}),
        hypothesis(prepared, "torque_saturation", 0, {"inverse_limit": 0.9}),
    ]
    found = Hypothesis(
        tuple(t for h in parts for t in h.terms), np.concatenate([h.theta for h in parts])
    )
    (expected,) = prepared.problem.at(found).predict([found], np.array([0]))
    (tmp_path / "realization").mkdir()
    write_realization(
        tmp_path / "realization", load_model(folder / "model.xml").realization,
        prepared.problem, found,
    )  # fmt: skip
    loaded = load_model(find_model(tmp_path))
    assert loaded.patched is not None
    (written,) = replay_patched(loaded.realization, loaded.patched, [trial])
    assert np.abs(written.position - expected[0].position).max() < 2e-4


def test_a_diagnosis_of_a_patched_model_uses_the_discretization_error_of_its_effects(
    bench: tuple[Path, Trial, PreparedProblem], tmp_path: Path
) -> None:
    folder, trial, prepared = bench
    problem = prepared.problem
    found = hypothesis(
        prepared, "joint_elasticity", 0, {"compliance": 1 / 40.0, "damping_time": 0.002}
    )
    problem = problem.at(found)
    (first,) = problem.predict([found], np.array([0]))[0]
    uncorrected = first.position - problem.discretization_error[0].position
    assert np.abs(problem.discretization_error[0].position).max() > 1e-5, (
        "the discretization error must be visible"
    )
    (tmp_path / "realization").mkdir()
    write_realization(
        tmp_path / "realization", load_model(folder / "model.xml").realization, problem, found
    )
    loaded = load_model(find_model(tmp_path))
    setup = ModelSetup.of(loaded.realization, loaded.patched, threads=1)
    reloaded, _ = build_problem(setup, TrialSet((trial,), (), ()), [])
    (later,) = reloaded.problem.predict([EMPTY], np.array([0]))[0]
    assert np.abs(later.position - first.position).max() < 1e-8
    assert np.abs(later.position - uncorrected).max() > 1e-5
    # Corrections at another hypothesis in between change nothing.
    reloaded.problem.at(hypothesis(reloaded, "armature", 1, {"inertia": 0.004}))
    (back,) = reloaded.problem.at(EMPTY).predict([EMPTY], np.array([0]))[0]
    assert (back.position == later.position).all()


def test_an_effect_at_a_joint_without_recording_is_left_out_with_a_note(
    bench: tuple[Path, Trial, PreparedProblem], tmp_path: Path
) -> None:
    folder, trial, prepared = bench
    limit = {"inverse_rate": 1.0, "inverse_effort_rate": 0.0, "of_effort": 0.0}
    found = hypothesis(prepared, "rate_limit", 1, limit)
    (tmp_path / "realization").mkdir()
    realization = load_model(folder / "model.xml").realization
    write_realization(tmp_path / "realization", realization, prepared.problem, found)
    loaded = load_model(find_model(tmp_path))
    fields = {n: getattr(trial, n) for n in Trial.__dataclass_fields__}
    for name in ("position", "velocity", "effort"):
        if fields[name] is not None:
            fields[name] = fields[name][:, :1]
    alone = Trial(**{**fields, "joints": JOINTS[:1]})
    notes: list[str] = []
    setup = ModelSetup.of(loaded.realization, loaded.patched, threads=1)
    reloaded, _ = build_problem(setup, TrialSet((alone,), (), ()), notes)
    assert reloaded.problem.joints == JOINTS[:1]
    assert notes == [
        f"rate_limit of joint {JOINTS[1]!r} is not applied: no recording contains this joint"
    ]


def test_a_servo_gain_error_scales_the_gains_of_a_controller_of_the_twin(tmp_path: Path) -> None:
    """The controller of a trial sets its gains after loading, so MJCF cannot contain the error."""
    (tmp_path / "model.xml").write_text(mjcf())
    (tmp_path / "twin.yaml").write_text(
        "name: pair\nmodel: model.xml\ncontrollers: {soft: {left: {kp: 3.0}}}\n"
    )
    loaded = load_model(tmp_path / "twin.yaml")
    trial = make_trial(read_recording(record(tmp_path / "a.mcap", 4, seconds=1.0)))
    trial = Trial(
        **{n: getattr(trial, n) for n in Trial.__dataclass_fields__ if n != "metadata"},
        metadata={"controller": "soft"},
    )
    prepared = prepare(loaded.realization, [trial], [])
    found = hypothesis(
        prepared, "controller_gain", 0, {"stiffness_error": 0.5, "damping_error": 0.0}
    )
    (expected,) = prepared.problem.at(found).predict([found], np.array([0]))
    (tmp_path / "out" / "realization").mkdir(parents=True)
    write_realization(tmp_path / "out" / "realization", loaded.realization, prepared.problem, found)
    reloaded = load_model(find_model(tmp_path / "out"))
    assert reloaded.patched is not None
    assert reloaded.realization.twin is not None
    assert reloaded.realization.twin.controllers == {"soft": {"left": {"kp": 3.0}}}
    (written,) = replay_patched(reloaded.realization, reloaded.patched, [trial])
    assert np.abs(written.position - expected[0].position).max() < 1e-5


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("schema"), "schema"),
        (lambda d: d["effects"][0].update(effect="gremlins"), "an installed effect"),
        (lambda d: d["effects"][0].update(joint="nose"), "one of joints"),
        (lambda d: d["effects"][0]["values"].update(coulomb=float("nan")), "finite number"),
        (lambda d: d["effects"][0]["values"].update(speed=1.0), "coulomb"),
        (lambda d: d["effects"][0].update(in_model="yes"), "true or false"),
        (lambda d: d.update(effects=7), "a list"),
        (lambda d: d.update(joints=[]), "names of joints"),
    ],
    ids=[
        "no schema",
        "unknown effect",
        "unknown joint",
        "value not finite",
        "unknown parameter",
        "text instead of a boolean",
        "no list of effects",
        "no joints",
    ],
)
def test_an_invalid_effects_file_is_refused(tmp_path: Path, change: object, words: str) -> None:
    data = {
        "schema": 1,
        "joints": list(JOINTS),
        "effects": [
            {
                "effect": "coulomb_friction", "joint": "left", "values": {"coulomb": 0.1},
                "in_model": False,
            }
        ],
    }  # fmt: skip
    path = tmp_path / EFFECTS_FILE
    path.write_text(json.dumps(data))
    assert read_effects(path).effects[0].values == {"coulomb": 0.1}
    change(data)  # type: ignore[operator]
    path.write_text(json.dumps(data))
    with pytest.raises(SpecError, match=words):
        read_effects(path)
