"""Recordings that a simulation made, which contain its discretization error."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.build_problem import build_problem
from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.run import Run
from pytest_twin.diagnosis.simulation_settings import adopt_simulation_step
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.errors import SpecError
from pytest_twin.formats.mcap import JointSeries, write_recording
from pytest_twin.gate.diagnosis_folder import write_diagnosis
from pytest_twin.loaded_model import find_model, load_model

STEP, SECONDS, NOISE = 0.002, 2.5, 2e-5
HIDDEN = 0.8
"""Additional viscous friction of the elbow, N*m*s/rad."""
ARM = """
<mujoco model="arm"><compiler angle="radian"/>
  <option timestep="{step}"/>
  <worldbody><body name="upper">
    <inertial pos="0.15 0 0" mass="1.5" diaginertia="0.001 0.015 0.015"/>
    <joint name="shoulder" axis="0 1 0" damping="0.4" armature="0.02"/>
    <body name="fore" pos="0.3 0 0">
      <inertial pos="0.12 0 0" mass="0.8" diaginertia="0.0005 0.005 0.005"/>
      <joint name="elbow" axis="0 1 0" damping="{damping}" armature="0.01"/>
    </body></body></worldbody>
  <actuator><position name="shoulder" joint="shoulder" kp="120" kv="4"/>
    <position name="elbow" joint="elbow" kp="60" kv="2"/></actuator>
</mujoco>
"""


def recorded(
    folder: Path, seed: int, role: str, *, substeps: int, damping: float, **metadata: str
) -> Path:
    """Record the arm in MuJoCo, with ``substeps`` steps in each time step of the model."""
    model = mujoco.MjModel.from_xml_string(ARM.format(step=STEP / substeps, damping=damping))
    data = mujoco.MjData(model)
    random = np.random.default_rng(seed)
    every = 5 * substeps
    count = round(SECONDS / model.opt.timestep)
    time = np.arange(count) * model.opt.timestep
    rate, size = random.uniform(2.0, 9.0, (2, 3)), random.uniform(0.1, 0.3, (2, 3))
    sent = (size[..., None] * np.sin(rate[..., None] * time)).sum(axis=1).T
    sent = sent[np.arange(count) // every * every]
    position = np.empty_like(sent)
    for k in range(count):
        position[k] = data.qpos
        data.ctrl[:] = sent[k]
        mujoco.mj_step(model, data)
    seen = np.arange(0, count, every)
    stamps = 1_700_000_000_000_000_000 + np.rint(time[seen] * 1e9).astype(np.int64)
    noisy = position[seen] + NOISE * random.standard_normal((len(seen), 2))
    names = ("shoulder", "elbow")
    series = [
        JointSeries("/joint_states", names, stamps, stamps, noisy, None, None),
        JointSeries("/joint_commands", names, stamps, stamps, sent[seen], None, None),
    ]
    path = folder / f"{role}{seed}.mcap"
    write_recording(path, series, {"role": role, **metadata})
    return path


def arm_case(folder: Path, substeps: int, added_damping: float, **metadata: str) -> tuple:
    (folder / "model.xml").write_text(ARM.format(step=STEP, damping=0.3))
    loaded = load_model(folder / "model.xml")
    files = [
        recorded(folder, seed, role, substeps=substeps, damping=0.3 + added_damping, **metadata)
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    return loaded.realization, read_trials(files, (), loaded.topics, loaded.realization.structure)


def is_detected(found: Diagnosis) -> bool:
    return any("the recordings come from a simulation" in note for note in found.notes)


@pytest.mark.parametrize(
    "substeps", [1, *(pytest.param(n, marks=pytest.mark.nightly) for n in (2, 4)), 5, 40]
)
def test_the_exact_model_has_no_mismatch_for_any_time_step_of_the_recorded_simulation(
    tmp_path: Path, substeps: int
) -> None:
    """The discretization error is 80 times the noise, and below it with 40 substeps."""
    found = diagnose(*arm_case(tmp_path, substeps, 0.0), threads=1)
    assert found.verdict == "no_mismatch"
    assert found.explanation.findings == ()
    assert is_detected(found) is (substeps < 40)
    if substeps < 40:
        assert all(e.after < 1.2 * NOISE for e in found.errors.values())


@pytest.mark.parametrize(
    ("source", "substeps", "taken"),
    [
        ("simulation", 1, 1),
        ("robot", 0, 0),
        ("https://example.org/recordings", 0, 0),
    ],
)
def test_metadata_may_say_what_made_the_recordings(
    tmp_path: Path, source: str, substeps: int, taken: int
) -> None:
    """The hidden friction leaves a residual, from which no simulation is recognised before it."""
    realization, trials = arm_case(tmp_path, 1, HIDDEN, source=source)
    setup = ModelSetup.of(realization, None, 1)
    prepared, trials = build_problem(setup, trials, [])
    found_setup, there, _ = adopt_simulation_step(setup, prepared, trials, Run())
    assert found_setup.substeps == substeps
    assert found_setup.is_of_robot is (source == "robot")
    assert bool(there.problem.discretization_error) is not bool(taken)


def test_a_declared_robot_is_never_taken_for_a_simulation(tmp_path: Path) -> None:
    realization, trials = arm_case(tmp_path, 1, 0.0, source="robot")
    setup = ModelSetup.of(realization, None, 1)
    prepared, trials = build_problem(setup, trials, [])
    found_setup, _, _ = adopt_simulation_step(setup, prepared, trials, Run())
    assert (found_setup.substeps, found_setup.is_of_robot) == (0, True)
    undeclared = arm_case(tmp_path, 1, 0.0)[1]
    found_setup, _, _ = adopt_simulation_step(setup, prepared, undeclared, Run())
    assert (found_setup.substeps, found_setup.is_of_robot) == (1, False)


def test_a_hidden_effect_in_recordings_of_a_simulation_is_found_exactly(tmp_path: Path) -> None:
    """With the usual correction of the prediction, wrong damping and inertia would be found."""
    realization, trials = arm_case(tmp_path, 1, HIDDEN)
    folder = tmp_path / "out"
    folder.mkdir()
    write_diagnosis(folder, realization, trials, model="arm", progress=lambda _: None)
    diagnosis = json.loads((folder / "diagnosis.json").read_text())
    assert diagnosis["verdict"] == "explained"
    assert any("with a time step of 2 ms" in note for note in diagnosis["notes"])
    (finding,) = diagnosis["findings"]
    assert (finding["effect"], finding["joint"]) == ("viscous_friction", "elbow")
    assert finding["parameters"]["coefficient"]["value"] == pytest.approx(HIDDEN, rel=1e-3)

    reloaded = load_model(find_model(folder))
    assert reloaded.patched is not None
    assert reloaded.patched.substeps == 1
    (trial,) = trials.held_out
    (predicted,) = replay_patched(reloaded.realization, reloaded.patched, [trial], threads=1)
    rms_error = np.sqrt(np.mean((predicted.position - trial.position) ** 2, axis=0))
    assert (rms_error < 1.2 * NOISE).all()

    # Recordings of a robot have no discretization error, also with findings from a simulation.
    for substeps, simulated in ((1, True), (40, False)):
        other = tmp_path / str(substeps)
        other.mkdir()
        _, trials = arm_case(other, substeps, HIDDEN)
        found = diagnose(reloaded.realization, trials, inherited=reloaded.patched, threads=1)
        assert found.verdict == "no_mismatch"
        assert is_detected(found) is simulated

    effects = folder / "realization/effects.json"
    written = json.loads(effects.read_text())
    for wrong in (-1, 1000, "one", True):
        effects.write_text(json.dumps({**written, "simulated_in_substeps": wrong}))
        with pytest.raises(SpecError, match=r"simulated_in_substeps.*an integer from 0 to 100"):
            load_model(find_model(folder))
