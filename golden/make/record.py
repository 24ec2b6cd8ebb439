"""Simulate recordings of the demo arm with a plant that shares no code with the twin.

Run ``python golden/make/record.py``; it writes ``golden/recordings/*.mcap``. No real arm is behind
them. The plant uses Pinocchio's rigid-body terms and its own integrator at 10 kHz. It has what the
twin's model lacks: Stribeck friction (Armstrong-Helouvry et al. 1994), a command delay, more
armature than the data sheet states, encoder counts, measurement noise and clock jitter.

Units: m, kg, rad, s, N, N*m.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
from mcap.writer import CompressionType, Writer

FOLDER = Path(__file__).resolve().parent.parent
JOINTS = ("base_yaw", "shoulder", "elbow", "wrist", "finger_left_slide")
STEP = 1e-4
SAMPLE = 0.01
EPOCH_NS = 1_760_000_000_000_000_000
# The mimic finger rides on the driven one: q = COUPLING @ q_driven.
COUPLING = np.vstack([np.eye(5), np.eye(5)[4]])

JOINT_STATE_SCHEMA = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


@dataclass(frozen=True)
class Plant:
    """The simulated machine; the drive's data sheet says kp, kv and the peak effort."""

    kp: np.ndarray = field(default_factory=lambda: np.array([180.0, 400.0, 160.0, 60.0, 1500.0]))
    kv: np.ndarray = field(default_factory=lambda: np.array([9.0, 18.0, 6.0, 2.0, 30.0]))
    peak: np.ndarray = field(default_factory=lambda: np.array([12.0, 25.0, 10.0, 4.0, 20.0]))
    armature: np.ndarray = field(
        default_factory=lambda: np.array([0.022, 0.032, 0.011, 0.0045, 0.1])
    )
    viscous: np.ndarray = field(default_factory=lambda: np.array([0.66, 0.86, 0.33, 0.11, 16.0]))
    coulomb: np.ndarray = field(default_factory=lambda: np.array([0.13, 0.21, 0.085, 0.032, 0.6]))
    stiction: np.ndarray = field(default_factory=lambda: np.array([0.17, 0.27, 0.11, 0.04, 0.75]))
    stribeck_velocity: float = 0.05
    latency: float = 0.004
    noise: np.ndarray = field(default_factory=lambda: np.array([2e-5] * 4 + [2e-6]))
    counts_per_unit: np.ndarray = field(
        default_factory=lambda: np.array([65536 / (2 * np.pi)] * 4 + [1e6])
    )


def simulate(
    plant: Plant,
    command: np.ndarray,
    start: np.ndarray,
    *,
    stiffness_scale: float = 1.0,
    payload: tuple[float, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (n, 5), velocity (n, 5) and drive effort (n, 5) at 10 kHz under commands (n, 5)."""
    model = pin.buildModelFromUrdf(str(FOLDER / "arm.urdf"))
    if payload is not None:
        mass, center = payload
        added = pin.Inertia(mass, center, np.zeros((3, 3)))
        model.inertias[model.getJointId("wrist")] += added
    data = model.createData()
    delay = round(plant.latency / STEP)
    q, v = start.copy(), np.zeros(5)
    positions, velocities, efforts = (np.empty_like(command) for _ in range(3))
    for k in range(len(command)):
        positions[k], velocities[k] = q, v
        held = command[max(k - delay, 0)]
        drive = stiffness_scale * plant.kp * (held - q) - plant.kv * v
        drive = np.clip(drive, -plant.peak, plant.peak)
        efforts[k] = drive
        q_all, v_all = COUPLING @ q, COUPLING @ v
        mass_matrix = pin.crba(model, data, q_all)
        mass_matrix = np.triu(mass_matrix) + np.triu(mass_matrix, 1).T
        inertia = COUPLING.T @ mass_matrix @ COUPLING + np.diag(plant.armature)
        bias = COUPLING.T @ pin.nonLinearEffects(model, data, q_all, v_all)
        driven = drive - bias - plant.viscous * v
        fall = np.exp(-((v / plant.stribeck_velocity) ** 2))
        level = plant.coulomb + (plant.stiction - plant.coulomb) * fall
        # Dry friction as the impulse that stops the joint, at most its level (Moreau 1988): the
        # joint sticks exactly, with no velocity band.
        free = v + STEP * np.linalg.solve(inertia, driven)
        impulse = np.clip(inertia.diagonal() * free, -STEP * level, STEP * level)
        v = free - np.linalg.solve(inertia, impulse)
        q = q + STEP * v
    return positions, velocities, efforts


def joint_state(stamp_ns: int, **fields: np.ndarray) -> bytes:
    """Encode one sensor_msgs/msg/JointState in little-endian CDR."""
    out = bytearray(b"\x00\x01\x00\x00")
    out += struct.pack("<iII", stamp_ns // 10**9, stamp_ns % 10**9, 1) + b"\x00"

    def align(size: int) -> None:
        out.extend(b"\x00" * (-(len(out) - 4) % size))

    align(4)
    out.extend(struct.pack("<I", len(JOINTS)))
    for name in JOINTS:
        align(4)
        out.extend(struct.pack("<I", len(name) + 1) + name.encode() + b"\x00")
    for key in ("position", "velocity", "effort"):
        values = fields.get(key, np.empty(0))
        align(4)
        out.extend(struct.pack("<I", len(values)))
        if len(values):
            align(8)
            out.extend(np.asarray(values, "<f8").tobytes())
    return bytes(out)


def record(
    name: str,
    seed: int,
    command: np.ndarray,
    start: np.ndarray,
    trial: dict[str, str],
    **setup: object,
) -> None:
    """Simulate one trial and write it as the arm's logger would."""
    plant = Plant()
    rng = np.random.default_rng(seed)
    position, velocity, effort = simulate(plant, command, start, **setup)  # type: ignore[arg-type]
    every = round(SAMPLE / STEP)
    jitter = rng.integers(-3, 4, size=len(command) // every)
    index = np.clip(np.arange(len(jitter)) * every + jitter, 0, len(command) - 1)
    path = FOLDER / "recordings" / f"{name}.mcap"
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema(
            "sensor_msgs/msg/JointState", "ros2msg", JOINT_STATE_SCHEMA.encode()
        )
        commands, states = (
            writer.register_channel(topic, "cdr", schema)
            for topic in ("/joint_commands", "/joint_states")
        )
        writer.add_metadata("trial", {"source": "golden/make/record.py", **trial})
        for k in index:
            stamp = EPOCH_NS + round(k * STEP * 1e9)
            measured = position[k] + plant.noise * rng.standard_normal(5)
            counts = np.round(measured * plant.counts_per_unit) / plant.counts_per_unit
            messages = (
                (commands, joint_state(stamp, position=command[k])),
                (
                    states,
                    joint_state(stamp, position=counts, velocity=velocity[k], effort=effort[k]),
                ),
            )
            for channel, message in messages:
                writer.add_message(channel, stamp, message, stamp)
        writer.finish()


def held(samples: np.ndarray) -> np.ndarray:
    """Commands as the controller sends them: new every sample, held in between."""
    every = round(SAMPLE / STEP)
    return np.repeat(samples, every, axis=0)


def main() -> None:
    """Write the recordings of the demo twin."""
    home = np.array([0.0, 0.4, 0.9, 0.4, 0.01])
    t = np.arange(0.0, 8.0, SAMPLE)[:, None]
    swing = np.array([0.5, 0.3, 0.4, 0.4, 0.008])
    rate = 2 * np.pi * np.array([0.23, 0.31, 0.41, 0.53, 0.37])
    # Reads as a smooth start: the amplitude grows over the first second.
    sines = home + swing * np.minimum(t, 1.0) * np.sin(rate * t)
    targets = home + swing * np.array(
        [
            [0, 0, 0, 0, 0],
            [1, 0, 0, 0, 1],
            [1, 1, -1, 0, 0],
            [-1, 0.5, 0.5, 1, 1],
            [0, -0.5, 0.8, -1, 0.5],
            [0, 0, 0, 0, 0],
        ]
    )
    # Trapezoid-like moves: 0.8 s between targets, then rest.
    last = len(targets) - 1
    leg = np.minimum((t / 1.3).astype(int), last - 1)[:, 0]
    phase = np.clip((t - 1.3 * leg[:, None]) / 0.8, 0.0, 1.0)
    blend = phase**2 * (3 - 2 * phase)
    moves = targets[leg] + blend * (targets[leg + 1] - targets[leg])
    record("sines", 1, held(sines), home, {"role": "fit", "controller": "stiff", "payload": "none"})
    record(
        "moves",
        2,
        held(moves),
        home,
        {"role": "held_out", "controller": "stiff", "payload": "none"},
    )
    record(
        "moves_soft",
        3,
        held(moves),
        home,
        {"role": "fit", "controller": "soft", "payload": "none"},
        stiffness_scale=0.5,
    )
    record(
        "sines_payload",
        4,
        held(sines),
        home,
        {"role": "fit", "controller": "stiff", "payload": "weight_300g"},
        payload=(0.3, np.array([0.0, 0.0, 0.1])),
    )


if __name__ == "__main__":
    main()
