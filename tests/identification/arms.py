"""A two-link arm whose parameters are known, and recordings of its effort by MuJoCo."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.realization import Realization, load

TRUE = """<mujoco model="two_links">
  <worldbody>
    <body name="upper">
      <inertial pos="{com} 0.01 0" mass="{mass}" diaginertia="0.02 0.1 0.1"/>
      <joint name="shoulder" axis="0 1 0" armature="{armature}" damping="{damping}"
             frictionloss="{friction}"/>
      <body name="lower" pos="0.5 0 0">
        <inertial pos="0.2 0 0.02" mass="2" diaginertia="0.01 0.05 0.05"/>
        <joint name="elbow" axis="0 1 0" armature="0.1" damping="{elbow}" frictionloss="0.3"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
REAL = {"com": 0.3, "mass": 4.0, "armature": 0.4, "damping": 1.5, "friction": 0.8, "elbow": 0.6}
NOMINAL = {"com": 0.25, "mass": 3.5, "armature": 0.2, "damping": 0.0, "friction": 0.0, "elbow": 0.0}
JOINTS = ("shoulder", "elbow")


def write_model(folder: Path, name: str = "model.xml", **changes: float) -> Path:
    path = folder / name
    path.write_text(TRUE.format(**{**NOMINAL, **changes}))
    return path


def real(folder: Path, **changes: float) -> Realization:
    return load(write_model(folder, "real.xml", **{**REAL, **changes}))


def record(
    realization: Realization,
    seed: int,
    seconds: float = 20.0,
    rate: float = 200.0,
    noise: float = 0.05,
    about: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (n,), positions (n, 2) and efforts (n, 2) along a random Fourier series.

    ``about``: mean of the shoulder, rad; at pi / 2 the arm hangs.
    """
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    q, v, a = (np.zeros((len(time), 2)) for _ in range(3))
    for joint in range(2):
        for harmonic in range(1, 6):
            omega = 2 * np.pi * 0.1 * harmonic
            size, phase = random.uniform(0.1, 0.6) / harmonic**0.5, random.uniform(0, 2 * np.pi)
            q[:, joint] += size * np.sin(omega * time + phase)
            v[:, joint] += size * omega * np.cos(omega * time + phase)
            a[:, joint] -= size * omega**2 * np.sin(omega * time + phase)
    q[:, 0] += about
    model, data = realization.model, mujoco.MjData(realization.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    effort = np.empty_like(q)
    for at in range(len(time)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[at], v[at], a[at]
        mujoco.mj_inverse(model, data)
        effort[at] = data.qfrc_inverse + model.dof_frictionloss * np.sign(v[at])
    effort += noise * random.standard_normal(effort.shape)
    return time, q + 1e-5 * random.standard_normal(q.shape), effort


def write_recording(path: Path, time: np.ndarray, position: np.ndarray, effort: np.ndarray) -> Path:
    head = ",".join(["time", *(f"{j}.position" for j in JOINTS), *(f"{j}.effort" for j in JOINTS)])
    table = np.column_stack([time, position, effort])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=head, comments="")
    return path
