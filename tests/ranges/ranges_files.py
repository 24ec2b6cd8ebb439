"""An arm with a known distribution of its parameters: twins, records and simulated recordings."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from fourier_motion import fourier

JOINTS = ("shoulder", "elbow")
TIMESTEP, RATE, NOISE = 0.002, 100, 2e-4
ARM = """<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <inertial pos="0.2 0 0.01" mass="2" diaginertia="0.01 0.04 0.04"/>
      <joint name="shoulder" axis="0 1 0" damping="1" frictionloss="0.3" armature="0.1"/>
      <body name="fore" pos="0.4 0 0">
        <inertial pos="0.12 0 0" mass="1" diaginertia="0.002 0.01 0.01"/>
        <joint name="elbow" axis="0 1 0" damping="0.5" frictionloss="0.2" armature="0.05"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="m1" joint="shoulder" kp="60" kv="4"/>
    <position name="m2" joint="elbow" kp="30" kv="2"/>
  </actuator>
</mujoco>
"""
DRIVES = tuple(
    f"{joint}.{kind}"
    for joint in JOINTS
    for kind in ("viscous_friction", "coulomb_friction", "armature")
)
NAMES = (*DRIVES, "mx2", "Iyy2")
"""The last two are base parameters of the second link: first moment and inertia about its joint."""
UNITS = ("N*m*s/rad", "N*m", "kg*m^2") * 2 + ("kg*m", "kg*m^2")
MEANS = np.array([1.0, 0.3, 0.1, 0.5, 0.2, 0.05, 0.12, 0.0244])
FIELDS = ("dof_damping", "dof_frictionloss", "dof_armature")
STD = np.array([0.25, 0.08, 0.02, 0.12, 0.05, 0.01, 0.006, 0.002])


def covariance(scale: float = 1.0, correlation: float = -0.6) -> np.ndarray:
    """Correlated pairs: viscous and Coulomb friction of each joint, first moment and inertia."""
    matrix = np.eye(len(NAMES))
    for a, b, rho in ((0, 1, correlation), (3, 4, correlation), (6, 7, 0.8)):
        matrix[a, b] = matrix[b, a] = rho
    return scale**2 * matrix * np.outer(STD, STD)


def record(matrix: np.ndarray, ident: str = "fitted", **changes: Any) -> dict[str, Any]:
    """``identification.json`` of the arm."""
    half = 1.96 * np.sqrt(np.abs(np.diag(matrix)))
    return {
        "schema": 1,
        "identification": ident,
        "verdict": "accepted",
        "stages": [{"stage": "friction", "state": "accepted"}],
        "parameters": {
            name: {"value": m, "unit": unit, "ci95": [m - h, m + h]}
            for name, unit, m, h in zip(NAMES, UNITS, MEANS.tolist(), half.tolist(), strict=True)
        },
        "covariance": {"names": list(NAMES), "matrix": matrix.tolist()},
        "held_out": {joint: {"effort_relative": 0.1} for joint in JOINTS},
        "trials": {"fit": ["a.mcap"], "held_out": ["b.mcap"]},
        "fit": {},
        **changes,
    }


def make_twin(
    folder: Path,
    records: Sequence[Mapping[str, Any]],
    more: str = "",
    arm: str = ARM,
) -> Path:
    """Write a twin with these records and return the path of its ``twin.yaml``."""
    folder.mkdir(exist_ok=True)
    (folder / "arm.xml").write_text(arm)
    text = "model: arm.xml\ncommand_between: held\n"
    text += "fit:\n" if records else ""
    for at, one in enumerate(records):
        (folder / f"fit{at}.json").write_text(json.dumps(one))
        text += f"  - {{file: fit{at}.json}}\n"
    path = folder / "twin.yaml"
    path.write_text(text + more)
    return path


def true_arm(values: np.ndarray) -> mujoco.MjModel:
    """The arm with these values of ``NAMES``; with constant mass, the moment shifts the centre."""
    model = mujoco.MjModel.from_xml_string(ARM)
    for joint in range(2):
        for k, field in enumerate(FIELDS):
            getattr(model, field)[joint] = max(values[3 * joint + k], 1e-6)
    moment, about_joint = values[6:]
    body = model.body("fore").id
    model.body_ipos[body, 0] = moment / model.body_mass[body]
    own = about_joint - moment**2 / model.body_mass[body]
    model.body_inertia[body, 1:] = max(own, 1e-4)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def record_motion(
    path: Path,
    model: mujoco.MjModel,
    rng: np.random.Generator,
    seconds: float = 4.0,
    role: str | None = "final",
    bias: float = 0.0,
) -> Path:
    """Write a recording of a simulated robot under a random smooth command.

    Args:
        bias: constant torque on the elbow, N*m, that the twin does not model.
    """  # fmt: skip
    data = mujoco.MjData(model)
    every = round(1.0 / RATE / model.opt.timestep)
    steps = round(seconds / model.opt.timestep)
    time = np.arange(steps) * model.opt.timestep
    command, _, _ = fourier(rng, time, 2, 4, 0.3, (0.1, 0.4), decay=1.0)
    command -= command[0]
    held = command[np.arange(steps) // every * every]
    mujoco.mj_forward(model, data)
    position = []
    for step in range(steps):
        if step % every == 0:
            position.append(data.qpos.copy())
        data.ctrl[:] = held[step]
        data.qfrc_applied[1] = bias
        mujoco.mj_step(model, data)
    read = np.array(position) + NOISE * rng.standard_normal((len(position), 2))
    stamps = (1e9 / RATE * np.arange(len(read))).astype(np.int64) + 10**18
    series = [
        JointSeries("/joint_states", JOINTS, stamps, stamps, read, None, None),
        JointSeries("/joint_commands", JOINTS, stamps, stamps, held[::every], None, None),
    ]
    metadata = {"command_between": "held"} | ({} if role is None else {"role": role})
    write_recording(path, series, metadata)
    return path
