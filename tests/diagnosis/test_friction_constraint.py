"""Dry friction that creeps at rest, as in recordings of a MuJoCo simulation."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.patched.write import write_realization
from pytest_twin.diagnosis.simulation_settings import FRICTION_CREEP_NOTE
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.effects.constraint import stiff_friction, stiffen_friction
from pytest_twin.errors import SpecError
from pytest_twin.formats.mcap import JointSeries, write_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.realization import Realization

STEP, SECONDS, NOISE = 2e-4, 1.8, 2e-6
ARM = """
<mujoco model="arm"><compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody><body name="upper">
    <inertial pos="0 0 -0.2" mass="2" diaginertia="0.03 0.03 0.002"/>
    <joint name="lift" axis="0 1 0" damping="0.3" armature="0.05" frictionloss="1.2"/>
    <body name="fore" pos="0 0 -0.4">
      <inertial pos="0 0 -0.15" mass="1" diaginertia="0.01 0.01 0.001"/>
      <joint name="bend" axis="0 1 0" damping="0.1" armature="0.02" frictionloss="0.5"/>
    </body></body></worldbody>
  <actuator><position name="lift" joint="lift" kp="60" kv="6"/>
    <position name="bend" joint="bend" kp="20" kv="2"/></actuator>
</mujoco>
"""


def recorded(folder: Path, seed: int, role: str, *, delay: float, holds: bool) -> Path:
    """Record the arm in MuJoCo, with a tenth of the time step of the model."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.opt.timestep = STEP
    if holds:
        model.dof_solref[:], model.dof_solimp[:] = stiff_friction(STEP)
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    time = np.arange(round(SECONDS / STEP)) * STEP
    wave = [
        0.4 * np.sin(2 * np.pi * f * time + p) * np.minimum(time, 1.0)
        for f, p in zip(random.uniform(0.2, 0.8, 2), random.uniform(0, 6, 2), strict=True)
    ]
    held = (np.arange(len(time)) // 50) * 50
    sent = np.array(wave).T[held]
    position = np.empty_like(sent)
    for k, at in enumerate(time):
        position[k] = data.qpos
        data.ctrl[:] = sent[max(round((at - delay) / STEP), 0), 0], sent[k, 1]
        mujoco.mj_step(model, data)
    start = 1_700_000_000_000_000_000
    seen, sent_at = np.arange(0, len(time), 25), np.arange(0, len(time), 50)
    stamps = [start + np.rint(time[k] * 1e9).astype(np.int64) for k in (seen, sent_at)]
    noisy = position[seen] + NOISE * random.standard_normal((len(seen), 2))
    names = ("lift", "bend")
    series = [
        JointSeries("/joint_states", names, stamps[0], stamps[0], noisy, None, None),
        JointSeries("/joint_commands", names, stamps[1], stamps[1], sent[sent_at], None, None),
    ]
    path = folder / f"{role}{seed}.mcap"
    write_recording(path, series, {"role": role, "command_between": "held"})
    return path


def arm_case(folder: Path, *, delay: float, holds: bool) -> tuple[Realization, TrialSet]:
    (folder / "model.xml").write_text(ARM)
    loaded = load_model(folder / "model.xml")
    files = [
        recorded(folder, seed, role, delay=delay, holds=holds)
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    return loaded.realization, read_trials(files, (), loaded.topics, loaded.realization.structure)


def diagnosed(
    folder: Path, *, delay: float = 0.0, holds: bool = False
) -> tuple[Realization, Diagnosis]:
    realization, trials = arm_case(folder, delay=delay, holds=holds)
    return realization, diagnose(realization, trials, threads=1)


@pytest.mark.parametrize("holds", [False, True], ids=["creeps", "holds"])
def test_the_exact_model_has_no_mismatch_with_either_friction_constraint(
    tmp_path: Path, holds: bool
) -> None:
    """The joints creep under dry friction, or hold at rest."""
    _, found = diagnosed(tmp_path, holds=holds)
    assert found.verdict == "no_mismatch"
    assert (FRICTION_CREEP_NOTE in found.notes) is not holds
    for error in found.errors.values():
        assert error.before < 1.5 * error.floor


def test_a_hidden_delay_is_found_and_creep_is_detected_from_the_residual(tmp_path: Path) -> None:
    """The mismatch is a hundred times the influence of creep."""
    realization, found = diagnosed(tmp_path, delay=0.012)
    assert found.verdict == "explained"
    assert [(f.effect, f.joint) for f in found.explanation.findings] == [("command_delay", "lift")]
    assert FRICTION_CREEP_NOTE in found.notes
    assert found.errors["lift"].before > 50.0 * found.errors["lift"].floor
    for error in found.errors.values():
        assert error.after < 1.5 * error.floor

    folder = tmp_path / "realization"
    folder.mkdir()
    problem, hypothesis = found.prepared.problem, found.explanation.hypothesis
    write_realization(folder, realization, problem, hypothesis)
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    np.testing.assert_allclose(model.dof_solref, [[0.02, 1.0]] * 2)
    reloaded = load_model(find_model(tmp_path))
    assert reloaded.patched is not None
    assert reloaded.patched.has_friction_creep
    (trial,) = found.tested.trials.held_out
    (predicted,) = replay_patched(reloaded.realization, reloaded.patched, [trial], threads=1)
    rms_error = np.sqrt(np.mean((predicted.position - trial.position) ** 2, axis=0))
    assert (rms_error < 1.5 * problem.floor).all()

    effects = json.loads((folder / "effects.json").read_text())
    (folder / "effects.json").write_text(json.dumps({**effects, "dry_friction": "melts"}))
    with pytest.raises(SpecError, match=r"dry_friction.*expected creeps"):
        load_model(find_model(tmp_path))


def test_the_search_adds_no_effect_with_the_friction_constraint_of_joints_that_creep(
    tmp_path: Path,
) -> None:
    """The joints hold: the residual of the wrong constraint leads to no further effect."""
    _, found = diagnosed(tmp_path, delay=0.012, holds=True)
    assert FRICTION_CREEP_NOTE not in found.notes
    assert [f.effect for f in found.explanation.findings] == ["command_delay"]
    assert found.verdict == "explained"


def test_a_friction_constraint_that_the_model_sets_is_kept() -> None:
    level = 'frictionloss="1.2"'
    own = ARM.replace(level, f'{level} solreffriction="0.01 0.8"')
    model = mujoco.MjModel.from_xml_string(own)
    stiffen_friction(model, [0, 1], 0.002)
    np.testing.assert_allclose(model.dof_solref[0], [0.01, 0.8])
    np.testing.assert_allclose(model.dof_solref[1], [0.004, 1.0])
    # The stiffest constraint that a time step allows is stiffer with a shorter time step.
    model.opt.timestep = 0.0005
    stiffen_friction(model, [0, 1], 0.002)
    np.testing.assert_allclose(model.dof_solref, [[0.01, 0.8], [0.001, 1.0]])
