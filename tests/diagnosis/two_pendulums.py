"""Simulated reality for the tests: two pendulums, each with a position servo.

The equations of motion are integrated at 10 kHz; the diagnosed model has a time step of 2 ms. Only
the writer of recordings comes from the package.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pytest_twin.formats.mcap import JointSeries, write_recording

JOINTS = ("left", "right")
STEP = 1e-4
START_NS = 1_700_000_000_000_000_000
DECLARED = {"command_between": "held", "source": "robot"}
MASS, LENGTH, INERTIA, ARMATURE = 0.5, 0.1, 0.002, 0.003
MAGNET_AT, MAGNET_WIDTH = 0.15, 0.1
KP, KV, DAMPING, LIMIT = 6.0, 0.15, 0.05, 5.0

_BODY = f"""
    <body name="{{0}}_link" pos="{{1}} 0 0">
      <inertial pos="0 0 {LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} 5e-4"/>
      <joint name="{{0}}" axis="0 1 0" damping="{DAMPING}" armature="{ARMATURE}"/>
    </body>"""
_SERVO = f'<position name="{{0}}" joint="{{0}}" kp="{KP}" kv="{KV}" forcerange="-{LIMIT} {LIMIT}"/>'


def mjcf(joints: tuple[str, ...] = JOINTS) -> str:
    """MJCF of the nominal model."""
    bodies = "".join(_BODY.format(name, at) for at, name in enumerate(joints))
    servos = "".join(_SERVO.format(name) for name in joints)
    return (
        '<mujoco model="pendulums"><compiler angle="radian"/>'
        '<option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{bodies}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def reference(seed: int, seconds: float, joints: int) -> np.ndarray:
    """(steps, joints) rad, a multisine with a zero-order hold at 100 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds / STEP)) * STEP
    f, phase = rng.uniform(0.3, 1.8, (3, joints)), rng.uniform(0, 2 * np.pi, (3, joints))
    wave = sum(0.3 * np.sin(2 * np.pi * t[:, None] * a + b) for a, b in zip(f, phase, strict=True))
    held = (np.arange(len(t)) // 100) * 100
    return (wave * np.minimum(t / 0.5, 1.0)[:, None])[held]


def simulate(
    setpoints: np.ndarray,
    *,
    delay: float = 0.0,
    viscous: float = 0.0,
    lag: float = 0.0,
    dry: float = 0.0,
    magnet: float = 0.0,
    joint: int = 0,
) -> np.ndarray:
    """Simulate (steps, joints) positions, rad, with hidden effects at one joint.

    Args:
        setpoints: (steps, joints) setpoints, rad.
        delay, lag: of the setpoint and of the servo's torque, s.
        viscous: additional viscous friction, N*m*s/rad.
        dry: dry friction, N*m.
        magnet: largest torque of a magnet at ``MAGNET_AT``, N*m.
        joint: index of the joint with these effects.
    """
    columns = []
    for j, column in enumerate(setpoints.T):
        hidden = (delay, viscous, lag, dry, magnet) if j == joint else (0.0,) * 5
        columns.append(_moved(column.tolist(), *hidden))
    return np.stack(columns, axis=1)


def _moved(
    setpoints: list[float], delay: float, viscous: float, lag: float, dry: float, magnet: float
) -> list[float]:
    """Positions of one joint; plain numbers are ten times as fast here as small arrays."""
    inertia = INERTIA + MASS * LENGTH**2 + ARMATURE
    delayed = round(delay / STEP)
    damping = DAMPING + viscous
    keep = math.exp(-STEP / lag) if lag else 0.0
    braked = STEP * dry / inertia
    given = q = v = 0.0
    out = []
    for sent in [setpoints[0]] * delayed + setpoints[: len(setpoints) - delayed]:
        out.append(q)
        demand = min(max(KP * (sent - q) - KV * v, -LIMIT), LIMIT)
        given = demand + keep * (given - demand)
        effort = given - damping * v + MASS * 9.81 * LENGTH * math.sin(q)
        if magnet:
            distance = (q - MAGNET_AT) / MAGNET_WIDTH
            effort -= magnet * distance * math.exp((1.0 - distance**2) / 2.0)
        v = v + STEP * effort / inertia
        v = math.copysign(max(abs(v) - braked, 0.0), v)
        q = q + STEP * v
    return out


def record(
    path: Path,
    seed: int,
    *,
    role: str | None = None,
    seconds: float = 1.2,
    joints: tuple[str, ...] = JOINTS,
    noise: float = 1e-4,
    metadata: Mapping[str, str] = DECLARED,
    **hidden: float,
) -> Path:
    """Write one recording of setpoints at 100 Hz and noisy positions at 200 Hz.

    By default the metadata state that commands are held, and that a robot was recorded. A diagnosis
    that finds this out itself takes a fifth longer.
    """
    setpoints = reference(seed, seconds, len(joints))
    moved = simulate(setpoints, **hidden)
    rng = np.random.default_rng([seed, 1])
    sent, seen = np.arange(0, len(setpoints), 100), np.arange(0, len(setpoints), 50)
    measured = moved[seen] + noise * rng.standard_normal((len(seen), len(joints)))
    write(
        path, joints, sent * STEP, setpoints[sent], seen * STEP, measured, role,
        metadata=metadata,
    )  # fmt: skip
    return path


def write(
    path: Path,
    joints: tuple[str, ...],
    sent_at: np.ndarray,
    sent: np.ndarray,
    seen_at: np.ndarray,
    seen: np.ndarray,
    role: str | None = None,
    velocity: np.ndarray | None = None,
    metadata: Mapping[str, str] | None = None,
    mode: str = "position",
) -> None:
    """Write commands (position, velocity or effort, see ``mode``) and states; times in s."""

    def stamps(time: np.ndarray) -> np.ndarray:
        return START_NS + np.rint(time * 1e9).astype(np.int64)

    fields = (sent if field == mode else None for field in ("position", "velocity", "effort"))
    write_recording(
        path,
        [
            JointSeries("/joint_commands", joints, stamps(sent_at), stamps(sent_at), *fields),
            JointSeries(
                "/joint_states", joints, stamps(seen_at), stamps(seen_at), seen, velocity, None
            ),
        ],
        {**({} if role is None else {"role": role}), **(metadata or {})},
    )


def case(
    folder: Path, joints: tuple[str, ...] = JOINTS, *, seconds: float = 1.2, **hidden: float
) -> list[str]:
    """Write a model and three recordings, one held out; return them as command-line arguments."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(mjcf(joints))
    files = [
        record(
            folder / f"{role}{seed}.mcap", seed, role=role, seconds=seconds, joints=joints, **hidden
        )
        for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out"))
    ]
    return [str(folder / "model.xml"), *map(str, files)]
