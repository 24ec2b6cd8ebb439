"""Draw blind cases: robot, hidden effects, sizes, excitations, sensors. One seed, one case.

``python benchmarks/concealed/cases.py --out DIR --truth DIR --seeds 0:200`` writes for each seed
``DIR/<case>/model.xml`` and ``recordings/*.mcap``, and the truth elsewhere.

Any 200 consecutive seeds contain 40 cases without hidden effects, 20 with two effects, 20 with
three, 20 with a force that is not in the catalogue (5 of each kind), and 100 with one effect. Every
effect of the catalogue occurs two or three times alone and at least once with others. The kind of a
case follows from the seed modulo 200; everything else is random.

The hidden effects are distinguishable in principle:

- an effect acts where it is observable (:data:`NEEDS`): with one joint, a command delay cannot be
distinguished from a sensor delay, nor base tilt from the encoder bias of a servo; on a slide or
a vertical first axis, an armature is the same physics as a heavier link; the gain of a velocity
servo is its torque constant;
- pairs that are the same physics (:data:`SAME`) do not share a joint: two of the laws that carry a
  constant level of dry friction, a servo's gain beside its torque constant or viscous friction.

No other pair is excluded. A hidden effect may be too small to be detected: the truth file states
the change of the held-out recordings (``visibility``, in standard deviations of sensor noise).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import struct
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# The last digits of a sum, and thus the digest of a truth file, depend on the OpenBLAS kernel of
# the processor. A fixed kernel is set before numpy is loaded.
if platform.machine() in ("x86_64", "AMD64"):
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

import numpy as np
from kernel import OUTSIDE, OUTSIDE_KINDS
from mcap.writer import CompressionType, Writer
from plant import RECORD, TICK, Hidden, Motion, simulate
from robots import RADIUS, Robot, draw, mjcf, tip_paths, with_contact

DURATION = 12.0
EPOCH_NS = 1_760_000_000_000_000_000
SCHEMA = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    "float64[] effort\n" + "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\n"
    "string frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
CONTACT_EFFECTS = ("contact_offset", "contact_stiffness", "contact_damping", "contact_friction")
EFFORT_EFFECTS = ("effort_bias", "effort_scale")
EFFECTS = (
    "command_delay", "sensor_delay", "clock_drift", "encoder_bias", "encoder_scale",
    "encoder_eccentricity", "effort_bias", "effort_scale", "actuator_lag", "rate_limit",
    "torque_constant", "torque_saturation", "torque_speed_limit", "dead_zone", "cogging",
    "controller_gain", "viscous_friction", "coulomb_friction", "asymmetric_friction",
    "stribeck_friction", "load_dependent_friction", "presliding_hysteresis", "thermal_friction",
    "position_dependent_friction", "quadratic_drag", "backlash", "joint_elasticity",
    "joint_spring", "joint_coupling", "payload", "inertial_parameters", "armature", "base_tilt",
    *CONTACT_EFFECTS, "external_force",
)  # fmt: skip
OF_THE_ROBOT = {"sensor_delay", "clock_drift", "payload", "base_tilt", *CONTACT_EFFECTS}
OUTSIDE_NAMES = OUTSIDE_KINDS[1:]
MODES = {"position": 0.65, "velocity": 0.15, "effort": 0.2}
COUNTS = {1: 0.25, 2: 0.25, 3: 0.2, 4: 0.1, 6: 0.15, 7: 0.05}


@dataclass(frozen=True)
class Need:
    """Conditions under which an effect can act and be observed.

    Attributes:
        joints: smallest and largest number of joints of the robot.
        gravity: only on joints whose gravity effort depends on the pose.
        upstream: only on joints behind another joint.
        hinges: only on revolute joints.
        contact: only on a robot that touches a surface.
    """

    joints: tuple[int, int] = (1, 7)
    modes: tuple[str, ...] = ("position", "velocity", "effort")
    gravity: bool = False
    upstream: bool = False
    hinges: bool = False
    contact: bool = False


_TOUCH = {"joints": (1, 3), "modes": ("position", "effort"), "hinges": True, "contact": True}
NEEDS = {
    "command_delay": Need((2, 7)),
    "sensor_delay": Need((2, 7)),
    "encoder_bias": Need(gravity=True, hinges=True),
    "encoder_eccentricity": Need(hinges=True),
    "rate_limit": Need(modes=("position", "velocity")),
    "torque_constant": Need(modes=("position", "effort")),
    "controller_gain": Need(modes=("position",)),
    "cogging": Need(hinges=True),
    "load_dependent_friction": Need(gravity=True, hinges=True),
    "position_dependent_friction": Need(hinges=True),
    "joint_coupling": Need((2, 7), upstream=True),
    "payload": Need(hinges=True),
    "inertial_parameters": Need((2, 7), gravity=True),
    "armature": Need(gravity=True, hinges=True),
    "base_tilt": Need((2, 7)),
    "contact_offset": Need(**_TOUCH),
    "contact_stiffness": Need(**_TOUCH),
    "contact_damping": Need(**_TOUCH),
    "contact_friction": Need(**{**_TOUCH, "joints": (2, 3)}),
}
SAME = (
    {"coulomb_friction", "asymmetric_friction", "stribeck_friction", "position_dependent_friction"},
    {"controller_gain", "torque_constant"},
    {"controller_gain", "viscous_friction"},
)

BLOCK = 200
ORDER = np.random.default_rng(20_261_120).permutation(BLOCK)
NOTHING, TWO, THREE, OUTSIDE_CASES = 40, 20, 20, 20
SEEDS = "first:last, last not included; several with commas; or the .jsonl of answers"


def plan(seed: int) -> tuple[str, list[str]]:
    """Return the kind of a seed and its fixed effect names; further effects are random."""
    place = int(ORDER[seed % BLOCK])
    if place < NOTHING:
        return "none", []
    place -= NOTHING
    if place < TWO + THREE:
        return "two" if place < TWO else "three", [EFFECTS[place % len(EFFECTS)]]
    place -= TWO + THREE
    if place < OUTSIDE_CASES:
        return "outside", [OUTSIDE_NAMES[place % len(OUTSIDE_NAMES)]]
    place -= OUTSIDE_CASES
    return "one", [EFFECTS[place % len(EFFECTS)]]


def sizes(effect: str, robot: Robot, joint: int, rng: np.random.Generator) -> dict[str, Any]:
    """Draw parameters of a hidden effect, in SI units, in proportion to the joint."""
    j = robot.joints[max(joint, 0)]
    effort = j.effort / 6.0
    band = max(j.kp, j.kv * 3.0) if robot.mode != "effort" else j.kp
    speed = 0.8
    sign = float(rng.choice([-1.0, 1.0]))
    u = lambda low, high: float(rng.uniform(low, high))  # noqa: E731
    # In a servo loop, a bias moves the arm and not the reading, which with one joint is equivalent
    # to a tilt.
    looped = robot.mode == "position" and len(robot.joints) > 1 and bool(rng.random() < 0.5)
    table: dict[str, Any] = {
        "command_delay": lambda: {"delay": u(0.01, 0.05)},
        "sensor_delay": lambda: {"delay": u(0.01, 0.05)},
        "clock_drift": lambda: {"drift": sign * u(0.002, 0.006)},
        "encoder_bias": lambda: {"bias": sign * (u(0.06, 0.2) if looped else u(0.02, 0.08)),
                                 "in_loop": looped},
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
                                    "damping_error": float(rng.choice([-1.0, 1.0])) * u(0.2, 0.5)},
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
                                     "damping_time": u(0.01, 0.02)},
        "joint_spring": lambda: {"stiffness": u(0.2, 0.5) * effort,
                                 "preload": u(-0.2, 0.2) * effort},
        "joint_coupling": lambda: {"ratio": sign * u(0.08, 0.25)},
        "payload": lambda: {"mass": u(0.4, 1.0) * robot.joints[-1].mass, "distance": u(0.05, 0.2)},
        "inertial_parameters": lambda: {"relative_error": u(0.25, 0.6)},
        "armature": lambda: {"inertia": u(1.0, 3.0) * j.armature},
        "base_tilt": lambda: {"roll": u(-0.12, 0.12), "pitch": sign * u(0.05, 0.12)},
        "contact_offset": lambda: {"offset": sign * u(0.005, 0.02)},
        "contact_stiffness": lambda: {"relative_error": u(1.0, 3.0) if sign > 0 else u(-0.7, -0.4)},
        "contact_damping": lambda: {"relative_error": u(2.0, 6.0) if sign > 0 else u(-0.9, -0.6)},
        "contact_friction": lambda: {"coefficient": u(0.2, 0.5) if sign > 0 else u(-0.28, -0.15)},
        "external_force": lambda: {"effort": sign * u(0.3, 0.6) * effort, "start": u(3.0, 7.0),
                                   "duration": u(0.8, 2.5)},
    }  # fmt: skip
    found: dict[str, Any] = table[effect]()
    return found


def joints_for(effect: str, robot: Robot) -> list[int]:
    """Return the joints at which an effect can act; -1 is the whole robot."""
    need = NEEDS.get(effect, Need())
    low, high = need.joints
    if not low <= len(robot.joints) <= high or robot.mode not in need.modes:
        return []
    if (need.contact and robot.contact is None) or (need.hinges and robot.joints[0].slide):
        return []
    if effect in OF_THE_ROBOT:
        return [-1]
    places = robot.gravity_joints() if need.gravity else list(range(len(robot.joints)))
    return [i for i in places if i or not need.upstream]


def hide(given: list[str], count: int, robot: Robot, rng: np.random.Generator) -> Hidden:
    """Choose ``count`` effects with the ``given`` ones, none with the same physics at a joint."""
    hidden = Hidden()
    others = [e for e in rng.permutation(EFFECTS) if e not in given]
    left = [*given, *(str(e) for e in others)]
    while sum(len(at) for at in hidden.effects.values()) < count:
        effect = left.pop(0)
        taken = {
            i for other, at in hidden.effects.items() for i in at
            if any({effect, other} <= same for same in SAME)
        }  # fmt: skip
        places = [i for i in joints_for(effect, robot) if i not in taken]
        if places:
            joint = int(rng.choice(places))
            hidden.effects[effect] = {joint: sizes(effect, robot, joint, rng)}
    return hidden


def excitation(robot: Robot, kind: str, center: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """References (ticks, joints) about a centre (joints,), new every 10 ms."""
    n = len(robot.joints)
    t = np.arange(0.0, DURATION, TICK)[:, None]
    amplitude = np.full(n, 0.25) if robot.joints[0].slide else rng.uniform(0.35, 0.7, n)
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
        if robot.mode == "velocity":  # steps of velocity
            out = np.stack([np.interp(t[:, 0], 1.2 * np.arange(10), x) for x in targets.T], axis=1)
        else:
            out = targets[np.minimum((t / 1.2).astype(int), 9)[:, 0]]
    else:  # slow reversals of two sizes
        period = rng.uniform(3.0, 5.0, n)
        triangle = 2 / np.pi * np.arcsin(np.sin(2 * np.pi * t / period))
        out = center + amplitude * triangle * np.where(t < DURATION / 2, 1.0, 0.3)
    if robot.mode == "velocity":
        out = np.gradient(out, TICK, axis=0)
        out = np.clip(out, -2.0, 2.0)
    return out


KINDS = ("multisine", "moves", "slow", "steps", "multisine")
ROLES = ("fit", "fit", "fit", "held_out", "held_out")
HELD_OUT = slice(ROLES.index("held_out"), None)


def excitations(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """References (ticks, recordings, joints) in the air."""
    n = len(robot.joints)
    slide = robot.joints[0].slide
    centers = [np.zeros(n) if slide else rng.uniform(-0.4, 0.4, n) for _ in KINDS]
    return np.stack(
        [excitation(robot, k, c, rng) for k, c in zip(KINDS, centers, strict=True)], axis=1
    )


def touching(robot: Robot, rng: np.random.Generator) -> tuple[Robot, np.ndarray]:
    """Return the robot at a wall or over a table, and references with contact in some motions."""
    n = len(robot.joints)
    table = bool(rng.random() < 0.5)
    normal = (0.0, 0.0, 1.0) if table else (-1.0, 0.0, 0.0)
    # The arm is stretched forward over a table, and upright at a wall.
    bends = [i for i in range(n) if robot.joints[i].axis[1]]
    lean = np.zeros(n)
    lean[bends] = (1.35 if table else 0.2) / len(bends)
    while True:
        centers = [lean + rng.uniform(-0.1, 0.1, n) for _ in KINDS]
        references = np.stack(
            [excitation(robot, k, c, rng) for k, c in zip(KINDS, centers, strict=True)], axis=1
        )
        above = tip_paths(robot, references) @ np.array(normal) - RADIUS
        # It starts in the air; the references do not go far into the surface.
        height = min(float(above[0].min()) - 0.005, float(above.min()) + 0.08)
        share = np.mean(above < height - 0.01, axis=0)
        if np.sum(share > 0.02) >= 3 and share[HELD_OUT].max() > 0.02:
            return with_contact(rng, robot, normal, height, lean), references


def outside(
    kind: str, joint: int, robot: Robot, references: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return a force that is not in the catalogue, (1,) record, in the joint's range of motion."""
    path = references[..., joint]
    if robot.mode == "velocity":
        path = np.cumsum(path, axis=0) * TICK
    force = np.zeros(1, OUTSIDE)
    force["kind"], force["joint"] = OUTSIDE_KINDS.index(kind), joint
    force["at"] = np.quantile(path, rng.uniform(0.35, 0.65))
    force["width"] = rng.uniform(0.03, 0.06)
    force["size"] = rng.uniform(0.8, 1.5) * robot.joints[joint].effort / 6.0
    return force


def stretches(acted: np.ndarray, size: float, record: float = RECORD) -> list[list[float]]:
    """Time intervals (start, end), s, in which a (samples,) force exceeded a tenth of its size."""
    on = np.concatenate([[False], np.abs(acted) > 0.1 * size, [False]])
    starts, ends = (np.flatnonzero(d) for d in (on[1:] & ~on[:-1], on[:-1] & ~on[1:]))
    found: list[list[float]] = []
    for start, end in zip(starts * record, ends * record, strict=True):
        if found and start - found[-1][1] < 0.05:
            found[-1][1] = round(float(end), 4)
        else:
            found.append([round(float(start), 4), round(float(end), 4)])
    return found


def taken(time: np.ndarray, hidden: Hidden) -> np.ndarray:
    """Time, s, of a reading with the stamp ``time`` of another clock, including the delay."""
    late: np.ndarray = time * (1 - hidden.robot("clock_drift", "drift"))
    return late - hidden.robot("sensor_delay", "delay")


def sampled(
    trace: np.ndarray, time: np.ndarray, hidden: Hidden, record: float = RECORD
) -> np.ndarray:
    """(samples, joints) values of a trace at the stamps ``time``, s, with delay and clock drift."""
    at = np.clip(taken(time, hidden) / record, 0, len(trace) - 1)
    before = np.minimum(at.astype(int), len(trace) - 2)
    part = (at - before)[:, None]
    out: np.ndarray = trace[before] * (1 - part) + trace[before + 1] * part
    return out


def message(names: list[str], fields: list[str]) -> tuple[np.ndarray, dict[str, int]]:
    """A sensor_msgs/msg/JointState in little-endian CDR, and the offsets of stamp and fields."""
    out = bytearray(b"\x00\x01\x00\x00")
    places = {"stamp": len(out)}
    out += struct.pack("<iII", 0, 0, 1) + b"\x00"

    def align(size: int) -> None:
        out.extend(b"\x00" * (-(len(out) - 4) % size))

    align(4)
    out += struct.pack("<I", len(names))
    for name in names:
        align(4)
        out += struct.pack("<I", len(name) + 1) + name.encode() + b"\x00"
    for key in ("position", "velocity", "effort"):
        align(4)
        out += struct.pack("<I", len(names) if key in fields else 0)
        if key in fields:
            align(8)
            places[key] = len(out)
            out += bytes(8 * len(names))
    return np.frombuffer(bytes(out), np.uint8), places


def messages(names: list[str], stamps: np.ndarray, fields: dict[str, np.ndarray]) -> np.ndarray:
    """(messages, bytes) of (messages, joints) fields, stamped in ns."""
    blank, places = message(names, list(fields))
    out = np.tile(blank, (len(stamps), 1))
    parts = {"stamp": np.stack([stamps // 10**9, stamps % 10**9], axis=1).astype("<u4")}
    parts |= {key: np.ascontiguousarray(values, "<f8") for key, values in fields.items()}
    for key, values in parts.items():
        raw = values.view(np.uint8)
        out[:, places[key] : places[key] + raw.shape[1]] = raw
    return out


def write(
    path: Path, robot: Robot, motion: Motion, hidden: Hidden, sensors: dict[str, Any],
    role: str, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Sample the motion of one recording like a logger, and write it."""
    names = [j.name for j in robot.joints]
    period = 1.0 / sensors["rate"]
    count = round(DURATION / period)
    jitter = rng.integers(-sensors["jitter"], sensors["jitter"] + 1, count) * 1e-4
    time = np.clip(np.arange(count) * period + jitter, 0.0, DURATION - 1e-4)
    # A logger with a slow clock stops with the motion, before its own time ends.
    time = time[taken(time, hidden) < DURATION]
    position = sampled(motion.position, time, hidden)
    position += sensors["noise"] * rng.standard_normal(position.shape)
    fields = {"position": np.round(position / sensors["count"]) * sensors["count"]}
    if sensors["velocity"]:
        noise = sensors["velocity_noise"] * rng.standard_normal(position.shape)
        fields["velocity"] = sampled(motion.velocity, time, hidden) + noise
    if sensors["effort"]:
        noise = effort_noise(robot) * rng.standard_normal(position.shape)
        fields["effort"] = sampled(motion.effort, time, hidden) + noise
    stamps = EPOCH_NS + np.round(time * 1e9).astype(np.int64)
    # Every command is logged once, independent of the encoder readings.
    sent = EPOCH_NS + np.round(np.arange(len(motion.setpoint)) * TICK * 1e9).astype(np.int64)
    rows = [
        (int(s), 0, m)
        for s, m in zip(sent, messages(names, sent, {robot.mode: motion.setpoint}), strict=True)
    ]
    rows += [(int(s), 1, m) for s, m in zip(stamps, messages(names, stamps, fields), strict=True)]
    rows.sort(key=lambda row: row[:2])
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", SCHEMA.encode())
        channels = [
            writer.register_channel(t, "cdr", schema) for t in ("/joint_commands", "/joint_states")
        ]
        writer.add_metadata("trial", {"role": role})
        for stamp, which, data in rows:
            writer.add_message(channels[which], stamp, data.tobytes(), stamp)
        writer.finish()


def effort_noise(robot: Robot) -> np.ndarray:
    """(joints,) standard deviation of the effort sensors, N*m or N."""
    return np.array([j.effort for j in robot.joints]) * 2e-3


SEEN_RECORD = 2 * RECORD
"""Time between samples and evaluations of Pinocchio's terms, s, of runs for the visibility."""


def visibility(
    effect: str, true: tuple[Motion, Hidden], without: tuple[Motion, Hidden], robot: Robot,
    sensors: dict[str, Any],
) -> float:  # fmt: skip
    """RMS change of held-out readings, in standard deviations of their noise.

    Readings are positions or, for effects of the effort sensor, efforts. The largest value over the
    joints is returned.
    """
    time = np.arange(0.0, DURATION - TICK, TICK)
    noise: Any = np.hypot(sensors["noise"], sensors["count"] / np.sqrt(12.0))
    which = "position"
    if effect in EFFORT_EFFECTS:
        noise, which = effort_noise(robot), "effort"
    change = [
        sampled(getattr(true[0], which)[:, i], time, true[1])
        - sampled(getattr(without[0], which)[:, i], time, without[1], SEEN_RECORD)
        for i in range(true[0].position.shape[1])
    ]
    return float(np.max(np.sqrt(np.mean(np.square(change), axis=(0, 1))) / noise))


def seen(
    robot: Robot, hidden: Hidden, motions: Motion, references: np.ndarray, start: np.ndarray,
    sensors: dict[str, Any], force: np.ndarray | None,
) -> tuple[dict[tuple[str, int], float], float | None]:  # fmt: skip
    """Return the visibility of each hidden effect, and of a force that is not in the catalogue.

    The held-out recordings are simulated again without the effect. An effort drive gets the same
    commands. An arm under effort commands diverges after any change, so it is restarted every 0.25
    s from its true state.
    """
    true = motions.recordings(HELD_OUT)
    again: dict[str, Any] = {"record": SEEN_RECORD}
    if robot.mode == "effort":
        again |= {"sent": true.setpoint, "restart": true.kept}

    def run(less: Hidden, push: np.ndarray | None) -> Motion:
        return simulate(
            robot, less, references[:, HELD_OUT], start[HELD_OUT], outside=push, **again
        )

    found = {}
    for effect, at in hidden.effects.items():
        for joint in at:
            less = hidden.without(effect, joint)
            other = run(less, force)
            found[effect, joint] = visibility(effect, (true, hidden), (other, less), robot, sensors)
    if force is None:
        return found, None
    other = run(hidden, None)
    return found, visibility("outside", (true, hidden), (other, hidden), robot, sensors)


def drawn(options: dict[Any, float], rng: np.random.Generator) -> Any:
    """Draw one of the options by weight."""
    keys, weights = list(options), np.array(list(options.values()))
    return keys[int(rng.choice(len(keys), p=weights / weights.sum()))]


def make(seed: int, out: Path, truth: Path, effect: str | None = None) -> str:
    """Write one case; returns its name.

    Args:
        seed: seed of all random draws.
        effect: ``none``, or the name of the hidden effect or outside force; None: by the seed.
    """
    rng = np.random.default_rng([20_261_120, seed])
    kind, given = plan(seed)
    if effect is not None:
        kind = "none" if effect == "none" else "outside" if effect in OUTSIDE_NAMES else "one"
        given = [] if effect == "none" else [effect]
    needs = [NEEDS.get(name, Need()) for name in given]
    counts = {
        c: w for c, w in COUNTS.items() if all(n.joints[0] <= c <= n.joints[1] for n in needs)
    }
    modes = {m: w for m, w in MODES.items() if all(m in n.modes for n in needs)}
    touches = any(n.contact for n in needs)
    if kind == "none" and rng.random() < 0.15:
        touches = True
        counts, modes = ({k: v for k, v in options.items() if k in allowed} for options, allowed in
                         ((counts, (1, 2, 3)), (modes, ("position", "effort"))))  # fmt: skip
    robot = draw(
        rng, drawn(counts, rng), drawn(modes, rng), hinges=touches or any(n.hinges for n in needs)
    )
    if touches:
        robot, references = touching(robot, rng)
    else:
        references = excitations(robot, rng)
    number = {"none": 0, "one": 1, "two": 2, "three": 3, "outside": 0}[kind]
    hidden = hide(given if number else [], number, robot, rng)
    force = None
    if kind == "outside":
        force = outside(given[0], int(rng.integers(len(robot.joints))), robot, references, rng)
    sensors = {
        "rate": float(rng.choice([100.0, 200.0])),
        "jitter": int(rng.choice([0, 5, 10])),
        "noise": float(rng.choice([2e-5, 1e-4, 3e-4])),
        "count": float(2 * np.pi / rng.choice([4096, 16384, 65536])),
        "velocity": bool(rng.random() < 0.4),
        "velocity_noise": 0.01,
        "effort": bool(rng.random() < 0.4) or bool(set(hidden.effects) & set(EFFORT_EFFECTS)),
    }
    name = f"case{seed:04d}"
    folder = out / name
    (folder / "recordings").mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(mjcf(robot))
    start = references[0] * (robot.mode != "velocity")
    motions = simulate(robot, hidden, references, start, outside=force)
    files = [f"{i}_{excite}.mcap" for i, excite in enumerate(KINDS)]
    for i, (file, role) in enumerate(zip(files, ROLES, strict=True)):
        motion = motions.recordings(i)
        write(folder / "recordings" / file, robot, motion, hidden, sensors, role, rng)
    seen_by, outside_seen = seen(robot, hidden, motions, references, start, sensors, force)
    outside_truth = None
    if force is not None:
        size = float(force["size"][0])
        outside_truth = {
            "kind": given[0], "joint": robot.joints[int(force["joint"][0])].name,
            "at": float(force["at"][0]), "width": float(force["width"][0]), "size": size,
            "visibility": outside_seen,
            "windows": {f: stretches(motions.outside[:, i], size) for i, f in enumerate(files)},
        }  # fmt: skip
    truth.mkdir(parents=True, exist_ok=True)
    record = {
        "case": name, "kind": kind, "mode": robot.mode, "joints": [j.name for j in robot.joints],
        "contact": robot.contact is not None,
        "effects": [
            {"effect": e, "joint": None if i < 0 else robot.joints[i].name, "parameters": p,
             "visibility": seen_by[e, i]}
            for e, at in hidden.effects.items() for i, p in at.items()
        ],
        "outside": outside_truth, "sensors": sensors,
    }  # fmt: skip
    (truth / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
    return name


def seeds(said: str) -> list[int]:
    """Parse seeds from the command line.

    They are ``first:last`` (last excluded) and single seeds, separated by commas, or a file of
    ``answers.py`` with cases.
    """
    if said.endswith(".jsonl"):
        answers = map(json.loads, Path(said).read_text().splitlines())
        return [int(answer["run"]["case"].removeprefix("case")) for answer in answers]
    found: list[int] = []
    for part in said.split(","):
        first, to, last = part.partition(":")
        found += range(int(first), int(last) if to else int(first) + 1)
    return found


def main() -> None:
    """Write the cases of some seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--seeds", type=seeds, default="0:8", help=SEEDS)
    parser.add_argument("--effect", help="none, or what alone is hidden in every case")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    if args.effect not in (None, "none", *EFFECTS, *OUTSIDE_NAMES):
        parser.error(f"--effect {args.effect}: none, {', '.join((*EFFECTS, *OUTSIDE_NAMES))}")
    with ProcessPoolExecutor(args.jobs) as pool:
        jobs = [pool.submit(make, s, args.out, args.truth, args.effect) for s in args.seeds]
        for job in jobs:
            print(job.result(), flush=True)


if __name__ == "__main__":
    main()
