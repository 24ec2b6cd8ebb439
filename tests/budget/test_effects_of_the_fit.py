"""The budget replays a twin with the effects of its fit that the MJCF cannot hold."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent))

from budget_files import ARM, FORE, UPPER, fit_record, make_twin, record_motion
from test_propagation import make_locked_arm

from pytest_twin.budget.budget_of_twin import budget_of_file
from pytest_twin.budget.categories import category_of_parameter
from pytest_twin.budget.changed_replays import Change, ChangedReplays
from pytest_twin.budget.effect_parameters import effect_parameter, with_values
from pytest_twin.commands.prediction import predict
from pytest_twin.diagnosis.patched.model import read_patched_model
from pytest_twin.open_loop import replay
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial, make_trials
from pytest_twin.trial.read import recordings_at
from pytest_twin.twin import load_twin

DELAY = {"effect": "command_delay", "joint": "shoulder", "values": {"delay": 0.03}}
STRIBECK = {
    "effect": "stribeck_friction",
    "joint": "elbow",
    "values": {"coulomb": 0.02, "stiction_excess": 0.03, "stribeck_velocity": 0.2},
}
BUDGET = "budget:\n  frame: tool\n  recordings: [motion.mcap]\n"
TIME = 0.01 * np.arange(101)


def with_effects(
    path: Path, effects: list[dict[str, Any]], joints: list[str], arm: str = ARM
) -> Path:
    """Make the twin's model the result of a fit with effects that its MJCF does not hold."""
    (path.parent / "found").mkdir()
    (path.parent / "found/model.xml").write_text(arm)
    listed = [{**one, "in_model": False} for one in effects]
    content = {"schema": 1, "joints": joints, "effects": listed}
    (path.parent / "found/effects.json").write_text(json.dumps(content))
    path.write_text(path.read_text().replace("model: arm.xml", "model: found"))
    return path


def arm_with(
    folder: Path, effects: list[dict[str, Any]], joints: tuple[str, ...] = ("shoulder", "elbow")
) -> tuple[Realization, Trial]:
    """The planar arm with effects, and a motion under commanded efforts."""
    path = with_effects(make_twin(folder), effects, list(joints))
    effort = 0.3 * np.stack([np.sin(9.0 * TIME), np.cos(7.0 * TIME)], axis=1)
    record_motion(folder / "motion.mcap", np.zeros((101, 2)), effort)
    twin = load_twin(path)
    robot = load(twin.first_realization.file, twin=twin)
    (recording,) = recordings_at(folder / "motion.mcap", twin.topics)
    (trial,) = make_trials(recording, robot.structure)
    return robot, trial


@pytest.mark.parametrize("joints", [("shoulder", "elbow"), ("elbow",)])
def test_the_nominal_replay_is_that_of_the_command_replay(
    tmp_path: Path, joints: tuple[str, ...]
) -> None:
    effects = [one for one in (DELAY, STRIBECK) if one["joint"] in joints]
    robot, trial = arm_with(tmp_path, effects, joints)
    (expected,), _ = predict(robot, read_patched_model(robot), [trial], lambda done: None)
    nominal = ChangedReplays(robot, trial).nominal.position
    columns = [trial.joints.index(joint) for joint in joints]
    assert expected.position is not None
    assert nominal[:, columns] == pytest.approx(expected.position, abs=0.0)
    (plain,) = replay(robot, [trial])
    assert np.abs(nominal - plain.position)[:, columns].max() > 0.01


def test_changed_damping_acts_as_in_a_twin_with_this_damping(tmp_path: Path) -> None:
    effects = [DELAY, STRIBECK]
    robot, trial = arm_with(tmp_path / "nominal", effects)
    damped = {
        "effect": "viscous_friction", "joint": "elbow", "values": {"coefficient": 0.1},
    }  # fmt: skip
    other, _ = arm_with(tmp_path / "damped", [*effects, damped])
    replays = ChangedReplays(robot, trial)
    damping = replays.model.dof_damping.copy()
    damping[robot.joint_dof_index("elbow")] += 0.1
    none = np.zeros(trial.position.shape)
    same, changed = replays.changed([Change(none), Change(none, {"dof_damping": damping})])
    assert same.position == pytest.approx(replays.nominal.position, abs=1e-12)
    expected = ChangedReplays(other, trial).nominal.position
    assert changed.position == pytest.approx(expected, abs=1e-12)
    assert np.abs(expected - same.position).max() > 1e-3


@pytest.mark.parametrize("joints", [("shoulder", "elbow"), ("elbow",)])
def test_an_added_force_acts_like_the_same_effort_of_the_drive(
    tmp_path: Path, joints: tuple[str, ...]
) -> None:
    """The arm's drives deliver what is commanded, so a commanded effort is a force."""
    robot, trial = arm_with(tmp_path, [STRIBECK], joints)
    force = np.full(trial.position.shape, 0.05)
    (changed,) = ChangedReplays(robot, trial).changed([Change(force)])
    record_motion(
        tmp_path / "more.mcap",
        np.zeros((101, 2)),
        0.05 + 0.3 * np.stack([np.sin(9.0 * TIME), np.cos(7.0 * TIME)], axis=1),
    )
    (recording,) = recordings_at(tmp_path / "more.mcap", load_twin(tmp_path / "twin.yaml").topics)
    (other,) = make_trials(recording, robot.structure)
    expected = ChangedReplays(robot, other).nominal.position
    assert changed.position == pytest.approx(expected, abs=1e-9)


def test_damping_that_only_an_effect_holds_shapes_the_propagation(tmp_path: Path) -> None:
    """Constant effort u on a hinge, I a = u - b v: derivative of the solution by b.

    The replay of a fitted model starts after the samples that determine its initial velocity.
    """
    inertia = 2 * 0.2**2 + 0.02 + 1 * 0.5**2 + 0.01
    effort, damping, deviation, start = 0.4, 0.5, 0.03, 0.07
    initial = effort / damping * (1.0 - np.exp(-damping * start / inertia))

    def angle(b: float, time: np.ndarray, first: float = 0.0) -> np.ndarray:
        """Angle after a time from a first velocity."""
        transient = (first - effort / b) * inertia / b
        return np.asarray(effort / b * time + transient * (1.0 - np.exp(-b * time / inertia)))

    since = np.maximum(TIME - start, 0.0)
    slope = (angle(damping + 1e-4, since, initial) - angle(damping - 1e-4, since, initial)) / 2e-4
    expected = deviation * np.sqrt(np.mean(slope**2))
    record = fit_record(["shoulder.viscous_friction"], [deviation], ["N*m*s/rad"])
    del record["held_out"]["elbow"]
    record["fit"] = {}
    path = make_twin(tmp_path, fits=[record], budget=BUDGET, arm=make_locked_arm())
    drag = {
        "effect": "viscous_friction", "joint": "shoulder", "values": {"coefficient": damping},
    }  # fmt: skip
    with_effects(path, [drag], ["shoulder"], make_locked_arm())
    record_motion(
        tmp_path / "motion.mcap", angle(damping, TIME)[:, None], np.full((101, 1), effort),
        ("shoulder",),
    )  # fmt: skip
    found = budget_of_file(str(path))
    (line,) = found["lines"]
    assert line["joints"]["shoulder"]["rms"] == pytest.approx(expected, rel=0.01)
    assert line["linear"]["position"] == pytest.approx((UPPER + FORE) * expected, rel=0.01)
    assert line["sampled"]["position"] == pytest.approx((UPPER + FORE) * expected, rel=0.05)
    assert found["notes"] == line["warnings"] == []


def drag_angle(drag: float, time: np.ndarray, effort: float, first: float) -> np.ndarray:
    """Angle of a hinge under a constant effort and drag: I a = u - c v |v|, from a velocity."""
    inertia = 2 * 0.2**2 + 0.02 + 1 * 0.5**2 + 0.01
    final, rise = np.sqrt(effort / drag), inertia / np.sqrt(effort * drag)
    phase = np.arctanh(first / final)
    return np.asarray(
        final * rise * (np.log(np.cosh(time / rise + phase)) - np.log(np.cosh(phase)))
    )


def test_an_effect_that_no_mjcf_contains_moves_the_frame(tmp_path: Path) -> None:
    """Its parameter is changed in the replays, to first order and by draws."""
    inertia, effort, drag, deviation, start = 0.36, 0.4, 0.5, 0.05, 0.07
    initial = np.sqrt(effort / drag) * np.tanh(start * np.sqrt(effort * drag) / inertia)
    since = np.maximum(TIME - start, 0.0)
    more, less = (drag_angle(drag + step, since, effort, initial) for step in (1e-4, -1e-4))
    expected = deviation * np.sqrt(np.mean(((more - less) / 2e-4) ** 2))
    record = fit_record(["shoulder.quadratic_drag"], [deviation], ["N*m*s^2/rad^2"])
    del record["held_out"]["elbow"]
    record["fit"] = {}
    path = make_twin(tmp_path, fits=[record], budget=BUDGET, arm=make_locked_arm())
    effect = {
        "effect": "quadratic_drag", "joint": "shoulder", "values": {"coefficient": drag},
    }  # fmt: skip
    with_effects(path, [effect], ["shoulder"], make_locked_arm())
    record_motion(
        tmp_path / "motion.mcap", drag_angle(drag, TIME, effort, 0.0)[:, None],
        np.full((101, 1), effort), ("shoulder",),
    )  # fmt: skip
    (line,) = budget_of_file(str(path))["lines"]
    assert line["left_out"] == []
    assert line["category"] == "friction_and_transmission"
    assert line["joints"]["shoulder"]["rms"] == pytest.approx(expected, rel=0.01)
    assert line["linear"]["position"] == pytest.approx((UPPER + FORE) * expected, rel=0.01)
    assert line["sampled"]["position"] == pytest.approx((UPPER + FORE) * expected, rel=0.05)


def test_without_a_motion_such_an_effect_is_left_out_with_a_reason(tmp_path: Path) -> None:
    record = fit_record(["elbow.stribeck_friction.stiction_excess"], [0.01], ["N*m"])
    record["fit"] = {}
    path = make_twin(tmp_path, fits=[record], budget="budget: {frame: tool}\n")
    with_effects(path, [STRIBECK], ["shoulder", "elbow"])
    (line,) = budget_of_file(str(path))["lines"]
    assert line["linear"] is None
    assert line["left_out"] == [
        "elbow.stribeck_friction.stiction_excess: no motion is known; budget: recordings: gives one"
    ]


def test_drawn_parameters_are_those_that_a_robot_can_have(tmp_path: Path) -> None:
    gain = {
        "effect": "controller_gain", "joint": "shoulder",
        "values": {"stiffness_error": -0.9, "damping_error": 0.0},
    }  # fmt: skip
    robot, _ = arm_with(tmp_path, [STRIBECK, gain])
    patched = read_patched_model(robot)
    assert patched is not None
    stiction, stiffness = (
        effect_parameter(name, robot, patched)
        for name in (
            "elbow.stribeck_friction.stiction_excess", "shoulder.controller_gain.stiffness_error",
        )
    )  # fmt: skip
    assert stiction is not None
    assert stiffness is not None
    changed = with_values(patched, {stiction: -0.2, stiffness: -1.3})
    values = {one.effect: one.values for one in changed.effects}
    assert values["stribeck_friction"] == {**STRIBECK["values"], "stiction_excess": 0.0}
    assert values["controller_gain"] == {"stiffness_error": -1.0, "damping_error": 0.0}
    assert effect_parameter("elbow.dead_zone", robot, patched) is None


@pytest.mark.parametrize(
    ("name", "category"),
    [
        ("elbow.torque_rolloff.back_emf", "actuation"),
        ("elbow.integral_gain", "actuation"),
        ("elbow.quadratic_drag", "friction_and_transmission"),
        ("elbow.presliding_hysteresis.coulomb", "friction_and_transmission"),
        ("elbow.joint_coupling", "friction_and_transmission"),
        ("elbow.joint_elasticity", "compliance_and_backlash"),
        ("elbow.coupled_viscous_friction", "friction_and_transmission"),
        ("robot.sensor_delay", "timing"),
        ("wrist.sensor_bias_fx", "sensing"),
        ("mx2 + 0.2*m3", "rigid_body_dynamics"),
    ],
)
def test_a_parameter_belongs_to_the_category_of_its_family(name: str, category: str) -> None:
    assert category_of_parameter(name) == category
