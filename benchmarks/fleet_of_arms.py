"""A fleet of simulated arms with six joints and measured effort, for the time of a trend."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization.loading import load

_AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
SECONDS, RATE = 20.0, 100
"""Length of a recording, s, and its states per second."""


def model() -> str:
    """MJCF of an arm with six joints."""
    text, end = "", ""
    for k, axis in enumerate(_AXES, 1):
        text += (
            f'<body name="link{k}" pos="{0 if k == 1 else 0.2} 0 0"><joint name="joint{k}" '
            f'axis="{axis}" damping="{0.6 / k:.2f}" armature="{0.05 / k:.3f}" '
            f'frictionloss="{0.5 / k:.2f}"/><geom type="capsule" size=".03" fromto="0 0 0 .18 0 0" '
            f'mass="{2.0 / k:.2f}"/>'
        )
        end += "</body>"
    return f'<mujoco model="arm"><worldbody>{text}{end}</worldbody></mujoco>'


def write_fleet(folder: Path, robots: int, sessions: int) -> Path:
    """Write the recordings of a fleet and its file; return the latter.

    One joint of every tenth robot wears after half of its sessions.
    """
    (folder / "arm.xml").write_text(model())
    joints = tuple(f"joint{k}" for k in range(1, len(_AXES) + 1))
    regressor = Regressor(load(folder / "arm.xml"), joints)
    time = np.arange(0.0, SECONDS, 1.0 / RATE)
    random = np.random.default_rng(0)
    position, speed, change = (np.zeros((len(time), len(joints))) for _ in range(3))
    for j in range(len(joints)):
        for frequency in (0.1, 0.3, 0.7):
            omega, phase = 2 * np.pi * frequency, random.uniform(0, 2 * np.pi)
            size = random.uniform(0.2, 0.5) / (1 + 4 * frequency)
            position[:, j] += size * np.sin(omega * time + phase)
            speed[:, j] += size * omega * np.cos(omega * time + phase)
            change[:, j] -= size * omega**2 * np.sin(omega * time + phase)
    matrix = regressor.matrix(position, speed, change)
    drive = np.array([not column.is_inertial for column in regressor.columns])
    wear = [c.name for c in regressor.columns].index("joint3.coulomb_friction")
    names = {}
    header = ",".join(
        ["time", *(f"{j}.position" for j in joints), *(f"{j}.effort" for j in joints)]
    )
    for robot in range(robots):
        here = folder / f"robot{robot:03d}"
        here.mkdir()
        for session in range(sessions):
            value = regressor.prior * np.where(
                drive, 1.0 + 0.03 * random.standard_normal(len(drive)), 1.0
            )
            if robot % 10 == 0 and session >= sessions // 2:
                value[wear] *= 1.5
            effort = matrix @ value + 0.02 * random.standard_normal(position.shape)
            begin = 1_767_225_600 + 604_800 * session
            stamps = (begin * 10**9 + np.rint(time * 1e9).astype(np.int64)).astype(str)
            table = np.char.mod("%.6f", np.hstack([position, effort]))
            rows = [",".join((stamp, *row)) for stamp, row in zip(stamps, table, strict=True)]
            (here / f"{session:02d}.csv").write_text("\n".join([header, *rows]) + "\n")
        files = [f"{here.name}/{session:02d}.csv" for session in range(sessions)]
        names[here.name] = {"model": "arm.xml", "recordings": files}
    path = folder / "fleet.yaml"
    path.write_text(json.dumps({"robots": names}))
    return path
