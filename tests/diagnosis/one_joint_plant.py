"""Simulated reality for tests of laws without a name: one pendulum with a position servo, in NumPy.

It integrates all recordings at once with a fourth-order Runge-Kutta method at 2 kHz. The hidden
force is a function of time, position and velocity. Only the writer of recordings comes from the
package.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from pytest_twin.formats.mcap import JointSeries, write_recording

JOINT = "elbow"
STEP, COMMAND, STATE = 5e-4, 0.01, 0.005
INERTIA, WEIGHT, DAMPING = 0.012, 0.49, 0.05
KP, KV = 6.0, 0.2
NOISE = 1e-4
START_NS = 1_700_000_000_000_000_000

Hidden = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""Hidden torque, (recordings,) N*m; arguments: time in s, position in rad, velocity in rad/s."""

MJCF = f"""
<mujoco model="pendulum"><compiler angle="radian"/>
<option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="link"><inertial pos="0 0 -0.1" mass="{WEIGHT / 0.981}"
 diaginertia="{INERTIA - WEIGHT / 98.1} {INERTIA - WEIGHT / 98.1} 0.001"/>
 <joint name="{JOINT}" axis="0 1 0" damping="{DAMPING}"/></body></worldbody>
<actuator><position name="{JOINT}" joint="{JOINT}" kp="{KP}" kv="{KV}"/></actuator></mujoco>
"""


def references(seconds: float, count: int) -> np.ndarray:
    """(commands, recordings) rad: multisine commands with other frequencies for each recording."""
    t = np.arange(0.0, seconds, COMMAND)[:, None]
    out = np.zeros((len(t), count))
    for k in range(count):
        rng = np.random.default_rng(40 + k)
        f, phase = rng.uniform(0.15, 1.1, 4), rng.uniform(0.0, 2.0 * np.pi, 4)
        out[:, k] = (0.35 * np.sin(2.0 * np.pi * t * f + phase)).sum(axis=1)
    return out * np.minimum(t / 0.5, 1.0)


def simulate(hidden: Hidden, seconds: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Simulate: (commands, recordings) commands and (states, recordings) positions, rad."""
    command = references(seconds, count)
    state = np.zeros((2, count))
    every, held = round(STATE / STEP), round(COMMAND / STEP)
    steps = len(command) * held
    out = np.empty((steps // every, count))
    for k in range(steps):
        if k % every == 0:
            out[k // every] = state[0]
        setpoint = command[k // held]

        def slope(t: float, x: np.ndarray, setpoint: np.ndarray = setpoint) -> np.ndarray:
            q, v = x
            effort = KP * (setpoint - q) - (KV + DAMPING) * v - WEIGHT * np.sin(q)
            return np.array([v, (effort + hidden(t, q, v)) / INERTIA])

        t = k * STEP
        a = slope(t, state)
        b = slope(t + STEP / 2, state + STEP / 2 * a)
        c = slope(t + STEP / 2, state + STEP / 2 * b)
        d = slope(t + STEP, state + STEP * c)
        state = state + STEP / 6 * (a + 2.0 * b + 2.0 * c + d)
    return command, out


def record(folder: Path, hidden: Hidden, seconds: float = 8.0, count: int = 5) -> list[Path]:
    """Write a model and recordings into a folder; the last two are held out."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(MJCF)
    command, position = simulate(hidden, seconds, count)
    position = position + NOISE * np.random.default_rng(7).standard_normal(position.shape)
    paths = []
    for k in range(count):
        stamps = [START_NS + np.arange(len(x)) * round(s * 1e9)
                  for x, s in ((command, COMMAND), (position, STATE))]  # fmt: skip
        series = [
            JointSeries(topic, (JOINT,), at, at, values[:, k : k + 1], None, None)
            for topic, at, values in zip(
                ("/joint_commands", "/joint_states"), stamps, (command, position), strict=True
            )
        ]
        paths.append(folder / f"{k}.mcap")
        metadata = {"role": "held_out" if k >= count - 2 else "fit", "command_between": "held"}
        write_recording(paths[-1], series, metadata)
    return paths
