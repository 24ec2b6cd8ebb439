"""A two-link arm with known parameters, and efforts simulated by MuJoCo."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pytest_twin.formats.mcap import write_recording as write_mcap_file
from pytest_twin.formats.recording import JointSeries
from pytest_twin.realization import Realization, load

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from fourier_motion import follow_noisy_positions, fourier, needed_effort

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


def true_arm(folder: Path, **changes: float) -> Realization:
    return load(write_model(folder, "real.xml", **{**REAL, **changes}))


def simulated_effort(
    realization: Realization,
    seed: int,
    seconds: float = 20.0,
    rate: float = 200.0,
    noise: float = 0.05,
    about: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (n,), positions (n, 2) and efforts (n, 2) along a random Fourier series.

    ``about``: mean angle of the shoulder, rad; at pi / 2 the arm hangs down.
    """
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    q, v, a = fourier(random, time, 2, 5, 0.1, (0.1, 0.6))
    q[:, 0] += about
    effort = needed_effort(realization.model, q, v, a)
    effort += noise * random.standard_normal(effort.shape)
    return time, q + 1e-5 * random.standard_normal(q.shape), effort


def write_recording(path: Path, time: np.ndarray, position: np.ndarray, effort: np.ndarray) -> Path:
    head = ",".join(["time", *(f"{j}.position" for j in JOINTS), *(f"{j}.effort" for j in JOINTS)])
    table = np.column_stack([time, position, effort])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=head, comments="")
    return path


def write_mcap(
    path: Path, time: np.ndarray, position: np.ndarray, effort: np.ndarray, payload: str
) -> Path:
    stamp = np.round(time * 1e9).astype(np.int64)
    series = JointSeries("/joint_states", JOINTS, stamp, stamp, position, None, effort)
    write_mcap_file(path, [series], {"payload": payload})
    return path


def closed_loop(
    realization: Realization, seed: int, noise: float, seconds: float = 20.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time (n,), measured positions, efforts and position commands (n, 2) of a servo at 200 Hz.

    The encoder noise (rad) lies below 3 Hz, as the motion does, and acts on the servo.
    """
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds / 0.005)) * 0.005
    command, speed, _ = fourier(random, time, 2, 5, 0.1, (0.1, 0.6))
    gains = np.array([200.0, 67.0]), np.array([20.0, 6.7])
    seen, effort = follow_noisy_positions(realization.model, random, command, speed, gains, noise)
    return time, seen, effort, command
