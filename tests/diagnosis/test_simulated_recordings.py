"""Recordings of a simulation are detected with the findings in the model."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.formats.mcap import JointSeries, write_recording
from pytest_twin.loaded_model import find_model, load_model

ADDED = 0.8
"""Additional viscous friction of the recorded joint, N*m*s/rad."""
PENDULUM = """
<mujoco model="pendulum"><compiler angle="radian"/>
  <option timestep="{step}" integrator="implicitfast"/>
  <worldbody><body pos="0 0 0.5">
    <joint name="j1" axis="0 1 0" damping="{damping}"/>
    <inertial pos="0 0 -0.15" mass="1" diaginertia="0.0035 0.0035 0.0005"/>
  </body></worldbody>
  <actuator><position name="j1" joint="j1" kp="40" kv="2"/></actuator>
</mujoco>
"""


def recorded(
    path: Path, seed: int, step: float, noise: float = 1e-4, *, with_force: bool = False
) -> Path:
    """Write a recording of a simulation as users log it.

    Each period sets the control, logs position and command, and steps for 10 ms. ``with_force``
    logs after the step, with velocity and actuator force; the force is that before the step.
    """
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(step=step, damping=0.3 + ADDED))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    rate, size = rng.uniform(2.0, 12.0, 4), rng.uniform(0.1, 0.3, 4)
    stamp = np.arange(300) * 10_000_000
    position, velocity, command, force = np.zeros((4, 300, 1))
    for k in range(300):
        position[k] = data.qpos + noise * rng.standard_normal()
        command[k] = data.ctrl[0] = float(size @ np.sin(rate * 0.01 * k))
        mujoco.mj_step(model, data, nstep=round(0.01 / step))
        if with_force:
            position[k] = data.qpos + noise * rng.standard_normal()
            velocity[k], force[k] = data.qvel, data.actuator_force
    stamp += 1_700_000_000_000_000_000
    logged = stamp + 10_000_000 if with_force else stamp
    write_recording(
        path,
        [
            JointSeries(
                "/joint_states",
                ("j1",),
                logged,
                logged,
                position,
                velocity if with_force else None,
                force if with_force else None,
            ),
            JointSeries("/joint_commands", ("j1",), stamp, stamp, command, None, None),
        ],
        metadata={} if with_force else {"command_between": "held"},
    )
    return path


def diagnosed(folder: Path, step: float, *, with_force: bool = False) -> Diagnosis:
    model = folder / "model.xml"
    model.write_text(PENDULUM.format(step=0.002, damping=0.3), "utf-8")
    recordings = [recorded(folder / f"r{i}.mcap", i, step, with_force=with_force) for i in range(3)]
    loaded = load_model(find_model(model))
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    return diagnose(loaded.realization, trials, threads=1)


@pytest.mark.parametrize(
    "step", [0.002, 0.0001], ids=["time step of the model", "a twentieth of it"]
)
def test_viscous_friction_is_right_for_every_time_step_of_the_recorded_simulation(
    tmp_path: Path, step: float
) -> None:
    found = diagnosed(tmp_path, step)
    (finding,) = found.explanation.findings
    assert finding.effect == "viscous_friction"
    estimate = finding.parameters["coefficient"]
    assert estimate.low <= ADDED <= estimate.high
    assert estimate.high - estimate.low < 0.05
    detected = any("the recordings come from a simulation" in note for note in found.notes)
    assert detected is (step == 0.002)


def test_a_simulation_that_logs_efforts_one_step_late_is_detected(tmp_path: Path) -> None:
    found = diagnosed(tmp_path, 0.002, with_force=True)
    (finding,) = found.explanation.findings
    assert finding.effect == "viscous_friction"
    estimate = finding.parameters["coefficient"]
    assert estimate.low <= ADDED <= estimate.high
    assert estimate.high - estimate.low < 0.05
    assert any("the recordings come from a simulation" in note for note in found.notes)
