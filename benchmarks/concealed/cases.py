"""Draw blind cases: robot, hidden effects, sizes, excitations, sensors. One seed, one case.

``python benchmarks/concealed/cases.py --out DIR --truth DIR --seeds 0:200`` writes for each seed
``DIR/<case>/model.xml`` and ``recordings/*.mcap``, and the truth elsewhere.
"""

from __future__ import annotations

import argparse
import json
import struct
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from plant import STEP, Hidden, Motion, simulate
from robots import Robot, draw, mjcf

DURATION = 12.0
EPOCH_NS = 1_760_000_000_000_000_000
SCHEMA = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    "float64[] effort\n" + "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    "string frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
JOINT_EFFECTS = [
    "command_delay", "encoder_bias", "encoder_scale", "encoder_eccentricity", "actuator_lag",
    "rate_limit", "torque_constant", "torque_saturation", "torque_speed_limit", "dead_zone",
    "cogging", "controller_gain", "viscous_friction", "coulomb_friction", "asymmetric_friction",
    "stribeck_friction", "load_dependent_friction", "presliding_hysteresis", "thermal_friction",
    "position_dependent_friction", "quadratic_drag", "backlash", "joint_elasticity",
    "joint_spring", "joint_coupling", "inertial_parameters", "armature", "external_force",
]  # fmt: skip
ROBOT_EFFECTS = ["sensor_delay", "clock_drift", "payload", "base_tilt"]
EFFORT_EFFECTS = ["effort_bias", "effort_scale"]
SERVO_ONLY = {"rate_limit", "controller_gain"}
OUTSIDE = ["magnetic_latch", "sticky_patch", "periodic_shaker", "loose_cable"]


def sizes(effect: str, robot: Robot, joint: int, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a hidden effect, in SI units, in proportion to the joint."""
    j = robot.joints[max(joint, 0)]
    effort = j.effort / 6.0
    band = max(j.kp, j.kv * 10.0) if robot.mode != "effort" else j.kp
    speed = 0.8
    sign = float(rng.choice([-1.0, 1.0]))
    u = lambda low, high: float(rng.uniform(low, high))  # noqa: E731
    table: dict[str, Any] = {
        "command_delay": lambda: {"delay": u(0.01, 0.05)},
        "sensor_delay": lambda: {"delay": u(0.01, 0.05)},
        "clock_drift": lambda: {"drift": sign * u(0.002, 0.006)},
        "encoder_bias": lambda: {"bias": sign * u(0.02, 0.08)},
        "encoder_scale": lambda: {"scale_error": sign * u(0.03, 0.1)},
        "encoder_eccentricity": lambda: {"sine": sign * u(0.02, 0.06), "cosine": u(-0.05, 0.05)},
        "effort_bias": lambda: {"bias": sign * u(0.1, 0.3) * effort},
        "effort_scale": lambda: {"scale_error": sign * u(0.15, 0.4)},
        "actuator_lag": lambda: {"time_constant": u(0.02, 0.06)},
        "rate_limit": lambda: {"rate": u(0.35, 0.7)},
        "torque_constant": lambda: {"relative_error": sign * u(0.15, 0.4)},
        "torque_saturation": lambda: {"limit": u(0.35, 0.6) * effort},
        "torque_speed_limit": lambda: {"stall": u(0.9, 1.4) * effort,
                                       "no_load_speed": u(0.8, 1.3)},
        "dead_zone": lambda: {"width": u(0.01, 0.03) if robot.mode == "position" else
                              u(0.04, 0.1) * (effort if robot.mode == "effort" else 1.0)},
        "cogging": lambda: {"sine": u(0.1, 0.3) * effort, "cosine": u(-0.1, 0.1) * effort,
                            "harmonic": float(rng.choice([6, 8, 12, 16]))},
        "controller_gain": lambda: {"stiffness_error": sign * u(0.2, 0.5),
                                    "damping_error": sign * u(0.2, 0.5)},
        "viscous_friction": lambda: {"coefficient": u(0.1, 0.4) * effort / speed},
        "coulomb_friction": lambda: {"coulomb": u(0.1, 0.35) * effort},
        "asymmetric_friction": lambda: {"coulomb": u(0.1, 0.25) * effort,
                                        "offset": sign * u(0.06, 0.1) * effort},
        "stribeck_friction": lambda: {"coulomb": u(0.06, 0.15) * effort,
                                      "stiction_excess": u(0.12, 0.25) * effort,
                                      "stribeck_velocity": u(0.05, 0.2)},
        "load_dependent_friction": lambda: {"coefficient": u(0.2, 0.5)},
        "presliding_hysteresis": lambda: {"coulomb": u(0.15, 0.35) * effort,
                                          "presliding_distance": u(0.02, 0.08)},
        "thermal_friction": lambda: {"excess": u(0.2, 0.4) * effort, "warm_up_time": u(2.0, 6.0)},
        "position_dependent_friction": lambda: {"mean": u(0.1, 0.2) * effort,
                                                "sine": sign * u(0.1, 0.2) * effort,
                                                "cosine": u(-0.05, 0.05) * effort},
        "quadratic_drag": lambda: {"coefficient": u(0.15, 0.4) * effort / speed**2},
        "backlash": lambda: {"gap": u(0.02, 0.06)},
        "joint_elasticity": lambda: {"stiffness": u(0.3, 0.8) * band,
                                     "damping": u(0.003, 0.01) * band},
        "joint_spring": lambda: {"stiffness": u(0.2, 0.5) * effort,
                                 "preload": u(-0.2, 0.2) * effort},
        "joint_coupling": lambda: {"ratio": sign * u(0.08, 0.25)},
        "payload": lambda: {"mass": u(0.4, 1.0) * robot.joints[-1].mass, "distance": u(0.05, 0.2)},
        "inertial_parameters": lambda: {"relative_error": u(0.25, 0.6)},
        "armature": lambda: {"inertia": u(1.0, 3.0) * j.armature},
        "base_tilt": lambda: {"roll": u(-0.12, 0.12), "pitch": sign * u(0.05, 0.12)},
        "external_force": lambda: {"effort": sign * u(0.3, 0.6) * effort, "start": u(3.0, 7.0),
                                   "duration": u(0.8, 2.5)},
    }  # fmt: skip
    found: dict[str, float] = table[effect]()
    return found


def excitation(robot: Robot, kind: str, rng: np.random.Generator) -> np.ndarray:
    """References (steps, joints) at 10 kHz, new every 10 ms."""
    n = len(robot.joints)
    t = np.arange(0.0, DURATION, 0.01)[:, None]
    if robot.joints[0].slide:
        amplitude, center = np.full(n, 0.25), np.zeros(n)
    else:
        amplitude = rng.uniform(0.35, 0.7, n)
        center = rng.uniform(-0.4, 0.4, n)
    if kind == "multisine":
        tones = rng.uniform(0.15, 1.4, (4, n))
        phase = rng.uniform(0, 2 * np.pi, (4, n))
        wave = sum(
            np.sin(2 * np.pi * f * t + p) / (1.0 + f) for f, p in zip(tones, phase, strict=True)
        )
        out = center + amplitude * wave * np.minimum(t / 1.0, 1.0) * 0.8
    elif kind == "moves":
        targets = center + amplitude * rng.uniform(-1, 1, (8, n))
        targets[0] = center
        leg = np.minimum((t / 1.5).astype(int), 6)[:, 0]
        s = np.clip((t % 1.5) / rng.uniform(0.4, 0.9), 0, 1)
        blend = s**3 * (10 - 15 * s + 6 * s * s)
        out = targets[leg] + blend * (targets[leg + 1] - targets[leg])
    elif kind == "steps":
        targets = center + 0.5 * amplitude * rng.uniform(-1, 1, (10, n))
        targets[0] = center
        out = targets[np.minimum((t / 1.2).astype(int), 9)[:, 0]]
    else:  # slow reversals of two sizes
        period = rng.uniform(3.0, 5.0, n)
        triangle = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * t / period))
        out = center + amplitude * triangle * np.where(t < DURATION / 2, 1.0, 0.3)
    if robot.mode == "velocity":
        out = np.gradient(out, 0.01, axis=0)
        out = np.clip(out, -2.0, 2.0)
    return np.repeat(out, round(0.01 / STEP), axis=0)


def outside(kind: str, joint: int, robot: Robot, rng: np.random.Generator):
    """A force that is in nobody's catalogue, and its truth."""
    effort = robot.joints[joint].effort / 6.0
    at, width = float(rng.uniform(-0.2, 0.2)), float(rng.uniform(0.03, 0.06))
    size = float(rng.uniform(0.8, 1.5)) * effort

    def force(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        out = np.zeros_like(q)
        x = (q[:, joint] - at) / width
        if kind == "magnetic_latch":
            out[:, joint] = -size * x * np.exp(0.5 - x * x / 2)
        elif kind == "sticky_patch":
            out[:, joint] = -size * np.tanh(v[:, joint] / 0.02) * np.exp(-((x / 2) ** 2))
        elif kind == "periodic_shaker":
            out[:, joint] = size * np.sin(2 * np.pi * 1.7 * t) * (t % 4.0 > 2.6)
        else:  # a cable that pulls tight in one direction only
            out[:, joint] = -3 * size * np.maximum(q[:, joint] - at - 0.1, 0.0) / 0.1
        return out

    return force, {"kind": kind, "joint": joint, "at": at, "width": width, "size": size}


def joint_state(names: list[str], stamp: int, fields: dict[str, np.ndarray]) -> bytes:
    """One sensor_msgs/msg/JointState in little-endian CDR."""
    out = bytearray(b"\x00\x01\x00\x00")
    out += struct.pack("<iII", stamp // 10**9, stamp % 10**9, 1) + b"\x00"

    def align(size: int) -> None:
        out.extend(b"\x00" * (-(len(out) - 4) % size))

    align(4)
    out.extend(struct.pack("<I", len(names)))
    for name in names:
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


def write(
    path: Path, robot: Robot, motion: Motion, hidden: Hidden, sensors: dict[str, Any],
    role: str, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Sample the motion as a logger would, and write it."""
    names = [j.name for j in robot.joints]
    every = round(1.0 / sensors["rate"] / STEP)
    count = len(motion.position) // every
    jitter = rng.integers(-sensors["jitter"], sensors["jitter"] + 1, count)
    index = np.clip(np.arange(count) * every + jitter, 0, len(motion.position) - 1)
    delay = round(hidden.robot("sensor_delay", "delay", 0.0) / STEP)
    drift = hidden.robot("clock_drift", "drift", 0.0)
    true_index = np.clip(np.round(index * (1 - drift)).astype(int) - delay, 0, None)
    position = motion.position[true_index]
    position = position + sensors["noise"] * rng.standard_normal(position.shape)
    position = np.round(position / sensors["count"]) * sensors["count"]
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", SCHEMA.encode())
        commands, states = (
            writer.register_channel(t, "cdr", schema) for t in ("/joint_commands", "/joint_states")
        )
        writer.add_metadata("trial", {"role": role})
        next_command = 0
        for k, (i, real) in enumerate(zip(index, true_index, strict=True)):
            stamp = EPOCH_NS + round(i * STEP * 1e9)
            # Every command once, whenever the encoders are read: a logger misses none.
            while next_command <= i:
                sent = EPOCH_NS + round(next_command * STEP * 1e9)
                payload = joint_state(names, sent, {robot.mode: motion.setpoint[next_command]})
                writer.add_message(commands, sent, payload, sent)
                next_command += 100
            fields = {"position": position[k]}
            if sensors["velocity"]:
                noise = sensors["velocity_noise"] * rng.standard_normal(len(names))
                fields["velocity"] = motion.velocity[real] + noise
            if sensors["effort"]:
                spread = np.array([j.effort for j in robot.joints]) * 2e-3
                fields["effort"] = motion.effort[real] + spread * rng.standard_normal(len(names))
            writer.add_message(states, stamp, joint_state(names, stamp, fields), stamp)
        writer.finish()


def make(seed: int, out: Path, truth: Path, kind: str | None = None) -> str:
    """Write one case; returns its name.

    Args:
        seed: draws everything.
        kind: ``one``, ``none``, ``several``, ``outside`` or an effect's name; None draws.
    """
    rng = np.random.default_rng([20_261_120, seed])
    if kind is None:
        kind = str(rng.choice(["one", "none", "several", "outside"], p=[0.5, 0.2, 0.2, 0.1]))
    count = int(rng.choice([1, 2, 3, 4, 6, 7], p=[0.25, 0.25, 0.2, 0.1, 0.15, 0.05]))
    mode = str(rng.choice(["position", "velocity", "effort"], p=[0.65, 0.15, 0.2]))
    pool = list(JOINT_EFFECTS) + ROBOT_EFFECTS + EFFORT_EFFECTS
    wanted = [kind] if kind in pool else []
    if kind == "one":
        wanted = [pool[seed % len(pool)]]
    elif kind == "several":
        wanted = list(rng.choice(pool, int(rng.integers(2, 4)), replace=False))
    if set(wanted) & SERVO_ONLY:
        mode = "position"
    if "joint_coupling" in wanted:
        count = max(count, 2)
    robot = draw(rng, count, mode)
    if robot.joints[0].slide and {"cogging", "load_dependent_friction", "base_tilt",
                                  "encoder_eccentricity"} & set(wanted):  # fmt: skip
        count = 2
        robot = draw(rng, count, mode)
    hidden = Hidden()
    for effect in wanted:
        if effect in ROBOT_EFFECTS:
            joint = -1
        elif effect == "joint_coupling":
            joint = int(rng.integers(1, count))
        else:
            joint = int(rng.integers(0, count))
        if effect in ("load_dependent_friction",) and count > 1:
            joint = max(joint, 1)
        hidden.effects.setdefault(effect, {})[joint] = sizes(effect, robot, joint, rng)
    extra, outside_truth = None, None
    if kind == "outside":
        extra, outside_truth = outside(
            str(rng.choice(OUTSIDE)), int(rng.integers(0, count)), robot, rng
        )
    sensors = {
        "rate": float(rng.choice([100.0, 200.0])),
        "jitter": int(rng.choice([0, 5, 10])),
        "noise": float(rng.choice([2e-5, 1e-4, 3e-4])),
        "count": float(2 * np.pi / rng.choice([4096, 16384, 65536])),
        "velocity": bool(rng.random() < 0.4),
        "velocity_noise": 0.01,
        "effort": bool(rng.random() < 0.4) or bool(set(wanted) & set(EFFORT_EFFECTS)),
    }
    name = f"case{seed:04d}"
    folder = out / name
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(mjcf(robot))
    kinds = ["multisine", "moves", "slow", "steps", "multisine"]
    roles = ["fit", "fit", "fit", "held_out", "held_out"]
    references = np.stack([excitation(robot, k, rng) for k in kinds], axis=1)
    start = np.zeros_like(references[0]) if mode == "velocity" else references[0].copy()
    motions = simulate(robot, hidden, references, start, extra=extra)
    for i, (excite, role) in enumerate(zip(kinds, roles, strict=True)):
        motion = motions.recording(i)
        path = folder / "recordings" / f"{i}_{excite}.mcap"
        write(path, robot, motion, hidden, sensors, role, rng)
    truth.mkdir(parents=True, exist_ok=True)
    record = {
        "case": name, "kind": kind, "mode": mode, "joints": [j.name for j in robot.joints],
        "effects": [
            {"effect": e, "joint": None if i < 0 else robot.joints[i].name, "parameters": p}
            for e, at in hidden.effects.items() for i, p in at.items()
        ],
        "outside": outside_truth, "sensors": sensors,
    }  # fmt: skip
    (truth / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
    return name


def main() -> None:
    """Write the cases of a range of seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--seeds", default="0:8")
    parser.add_argument("--kind")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    first, last = (int(x) for x in args.seeds.split(":"))
    with ProcessPoolExecutor(args.jobs) as pool:
        jobs = [pool.submit(make, s, args.out, args.truth, args.kind) for s in range(first, last)]
        for job in jobs:
            print(job.result(), flush=True)


if __name__ == "__main__":
    main()
