"""Simulated histories of a planar arm with measured effort."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from pytest_twin.identification.regressor.regressor import Regressor
from pytest_twin.realization.loading import load

ARM = """\
<mujoco model="arm"><compiler angle="radian"/><worldbody>
<body name="upper"><joint name="lift" axis="0 1 0" range="-3 3" damping=".3" armature=".02"
frictionloss=".3"/><geom type="capsule" size=".03" fromto="0 0 0 .25 0 0" mass=".7"/>
<body name="lower" pos=".25 0 0"><joint name="elbow" axis="0 1 0" range="-3 3" damping=".1"
armature=".01" frictionloss=".15"/>
<geom type="capsule" size=".03" fromto="0 0 0 .15 0 0" mass=".3"/></body></body></worldbody>
</mujoco>
"""
JOINTS = ("lift", "elbow")
START = datetime(2026, 3, 2, 9, 0, tzinfo=UTC)
Parameters = dict[str, float]
"""``JOINT.KIND`` -> value, of the columns of the regressor."""


@dataclass(frozen=True)
class History:
    """How the sessions of a robot are simulated.

    Attributes:
        sessions: number of sessions, a week apart.
        scatter: standard deviation of each drive parameter between sessions, relative.
        noise: standard deviation of a sample of effort, N*m.
        change: changes the parameters of a session, given its number and its parameters.
        during: changes the parameters along a session: fraction of it, parameters.
        metadata: metadata of each session.
        mass: true mass of the links relative to the model's.
    """

    sessions: int = 10
    scatter: float = 0.03
    noise: float = 0.02
    change: Callable[[int, Parameters], None] = lambda session, parameters: None
    during: Callable[[float, Parameters], None] | None = None
    metadata: Callable[[int], Mapping[str, str]] = field(default=lambda session: {})
    stamped: bool = True
    mass: float = 1.1
    seconds: float = 12.0

    def date(self, session: int) -> datetime:
        """Date of a session."""
        return START + timedelta(days=7 * session)

    def write(self, folder: Path, seed: int = 0) -> list[Path]:
        """Write the model and a CSV file for each session; return these."""
        (folder / "arm.xml").write_text(ARM)
        if not (folder / "twin.yaml").exists():
            (folder / "twin.yaml").write_text("model: arm.xml\n")
        regressor = Regressor(load(folder / "arm.xml"), JOINTS)
        names = [column.name for column in regressor.columns]
        rigid = np.array([column.is_inertial for column in regressor.columns])
        random = np.random.default_rng(seed)
        paths = []
        for session in range(self.sessions):
            value = dict(zip(names, np.where(rigid, self.mass, 1.0) * regressor.prior, strict=True))
            for k, name in enumerate(names):
                if not rigid[k]:
                    value[name] *= 1.0 + self.scatter * random.standard_normal()
            for joint in JOINTS:
                value[f"{joint}.effort_bias"] += 0.2 * self.scatter * random.standard_normal()
            self.change(session, value)
            time = np.arange(0.0, self.seconds, 0.01)
            states = _motion(time, random)
            matrix = regressor.matrix(*states)
            parameters = np.array([value[name] for name in names])
            effort = matrix @ parameters
            if self.during is not None:
                for i in range(0, len(time), 100):
                    now = dict(value)
                    self.during(time[i] / time[-1], now)
                    changed = np.array([now[name] for name in names])
                    effort[i : i + 100] = matrix[i : i + 100] @ changed
            effort += self.noise * random.standard_normal(effort.shape)
            paths.append(self._write_session(folder, session, time, states[0], effort))
        return paths

    def _write_session(
        self, folder: Path, session: int, time: np.ndarray, position: np.ndarray, effort: np.ndarray
    ) -> Path:
        path = folder / f"session_{session:02d}.csv"
        begin = int(self.date(session).timestamp() * 1e9) if self.stamped else 0
        stamps = begin + np.rint(time * 1e9).astype(np.int64)
        header = ["time", *(f"{j}.position" for j in JOINTS), *(f"{j}.effort" for j in JOINTS)]
        lines = [",".join(header)]
        for stamp, q, tau in zip(stamps.tolist(), position, effort, strict=True):
            lines.append(",".join([str(stamp), *(f"{x:.6f}" for x in (*q, *tau))]))
        path.write_text("\n".join(lines) + "\n")
        metadata = self.metadata(session)
        if metadata:
            text = "".join(f"{key}: '{value}'\n" for key, value in metadata.items())
            path.with_name(path.name + ".yaml").write_text(text)
        return path


def _motion(
    time: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations of a random sum of sines."""
    position, velocity, acceleration = (np.zeros((len(time), len(JOINTS))) for _ in range(3))
    for j in range(len(JOINTS)):
        for frequency in (0.1, 0.25, 0.6):
            omega = 2 * np.pi * frequency
            amplitude = random.uniform(0.3, 0.6) / (1 + 4 * frequency)
            phase = omega * time + random.uniform(0, 2 * np.pi)
            position[:, j] += amplitude * np.sin(phase)
            velocity[:, j] += amplitude * omega * np.cos(phase)
            acceleration[:, j] -= amplitude * omega**2 * np.sin(phase)
    return position, velocity, acceleration
