"""Simulated reality for the tests: one pendulum with a servo, and its logger.

The equation of motion is integrated at 10 kHz; the diagnosed model has a time step of 1 ms. Only
the writer of recordings comes from the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pytest_twin.formats.mcap import JointSeries, write_recording

STEP = 1e-4
MASS, LENGTH, INERTIA, ARMATURE = 0.9, 0.175, 0.0095, 0.02
KP, KV, DAMPING, DRY, GRAVITY = 60.0, 2.0, 0.1, 0.1, 9.81
MODEL = f"""
<mujoco model="pendulum"><compiler angle="radian"/>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody><body name="link">
    <inertial pos="0 0 {LENGTH}" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} 0.0007"/>
    <joint name="j1" axis="0 1 0" armature="{ARMATURE}" damping="{DAMPING}" frictionloss="{DRY}"/>
  </body></worldbody>
  <actuator>{{actuator}}</actuator>
</mujoco>
"""
SERVO = f'<position name="a1" joint="j1" kp="{KP}" kv="{KV}"/>'
MOTOR = '<motor name="a1" joint="j1"/>'


@dataclass(frozen=True)
class Reality:
    """Properties of the robot and its logger; by default those of the model.

    Attributes:
        between: how the controller interpolates between two logged commands.
        command_period, state_period: sampling periods of the log, s.
        delay, lag: of the command and of the torque, s.
        stiffness, damping, dry: servo gains and dry friction, times those of the model.
        viscous: additional viscous friction, N*m*s/rad.
        play: half the dead zone of the servo's position error, rad.
        effort: logged effort: none, the measured torque, or the torque that the controller demands.
        effort_late: age of the logged effort at its stamp, s.
        velocity: logged velocity: none, that of a sensor, or differences of the logged positions.
        filtered: time constant of a low-pass filter on these differences, s; 0 for no filter.
        noise: standard deviation of the logged positions, rad.
        driven: whether the commands are efforts instead of positions.
        stepping: whether the moves of odd seeds are steps, 1 ms after a stamp.
    """

    between: Literal["held", "interpolated", "ramped"] = "held"
    command_period: float = 0.004
    state_period: float = 0.004
    delay: float = 0.0
    lag: float = 0.0
    stiffness: float = 1.0
    damping: float = 1.0
    viscous: float = 0.0
    dry: float = 1.0
    play: float = 0.0
    effort: Literal["none", "measured", "demanded"] = "none"
    effort_late: float = 0.0
    velocity: Literal["none", "sensor", "differenced"] = "none"
    filtered: float = 0.0
    noise: float = 1e-4
    driven: bool = False
    stepping: bool = False


def setpoints(seed: int, time: np.ndarray, *, stepping: bool = False) -> np.ndarray:
    """(n,) setpoints, rad: four sines; with an odd seed, moves at 3 rad/s with rests between."""
    rng = np.random.default_rng(seed)
    if seed % 2:
        begins = np.arange(0.2, time[-1], 0.6)
        if stepping:
            levels = np.concatenate([[0.0], rng.uniform(-0.6, 0.6, len(begins))])
            found: np.ndarray = levels[np.searchsorted(begins + 1e-3, time)]
            return found
        levels = rng.uniform(-0.6, 0.6, len(begins))
        corners, values, last = [0.0], [0.0], 0.0
        for begin, level in zip(begins, levels, strict=True):
            corners += [begin, begin + max(abs(level - last) / 3.0, 0.02)]
            values += [last, level]
            last = level
        return np.interp(time, corners, values)
    rate, phase = np.array([0.4, 0.9, 1.9, 3.3]), rng.uniform(0.0, 2.0 * np.pi, 4)
    size = np.array([0.4, 0.2, 0.1, 0.05])
    waves = size[:, None] * np.sin(2.0 * np.pi * rate[:, None] * time + phase[:, None])
    return waves.sum(axis=0) * np.minimum(time / 0.3, 1.0)


def commanded(seed: int, reality: Reality, time: np.ndarray) -> tuple[np.ndarray, ...]:
    """Stamps and values of the logged commands, and the setpoints at each time."""
    period = reality.command_period
    stamps = np.arange(0.0, time[-1] + period, period)
    values = setpoints(seed, stamps, stepping=reality.stepping)
    if reality.driven:
        values = 4.0 * values
    index = np.searchsorted(stamps, time + 1e-9, side="right") - 1
    if reality.between == "held":
        follows = values[index]
    elif reality.between == "interpolated" and reality.stepping:
        follows = setpoints(seed, time, stepping=True)
    elif reality.between == "interpolated":
        follows = np.interp(time, stamps, values)
    else:
        before = values[np.maximum(index - 1, 0)]
        follows = before + (values[index] - before) * (time - stamps[index]) / period
    return stamps, values, follows


def simulate(seed: int, reality: Reality, seconds: float) -> dict[str, np.ndarray]:
    """Simulate the motion: time, position, velocity, demanded and actual torque at every step."""
    time = np.arange(0.0, seconds, STEP)
    stamps, values, follows = commanded(seed, reality, time)
    late = round(reality.delay / STEP)
    follows = np.concatenate([np.full(late, follows[0]), follows])[: len(time)]
    inertia = INERTIA + MASS * LENGTH**2 + ARMATURE
    keep = math.exp(-STEP / reality.lag) if reality.lag else 0.0
    kp, kv = KP * reality.stiffness, KV * reality.damping
    damping, braked = DAMPING + reality.viscous, STEP * (DRY * reality.dry) / inertia
    q = v = torque = 0.0
    moved = []
    # Plain numbers are several times as fast here as NumPy's.
    for u in follows.tolist():
        if reality.driven:
            demand = u
        else:
            error = u - q
            error -= min(max(error, -reality.play), reality.play)
            demand = kp * error - kv * v
        torque = keep * torque + (1.0 - keep) * demand
        moved.append((q, v, kp * (u - q) - kv * v if not reality.driven else u, torque))
        pull = torque + MASS * GRAVITY * LENGTH * math.sin(q) - damping * v
        v += STEP * pull / inertia
        # Dry friction stops the joint, and does not reverse it.
        v = math.copysign(max(abs(v) - braked, 0.0), v)
        q += STEP * v
    out = np.array(moved).T
    return {
        "time": time, "position": out[0], "velocity": out[1], "demand": out[2], "torque": out[3],
        "stamps": stamps, "values": values,
    }  # fmt: skip


def record(
    path: Path, seed: int, reality: Reality, *, role: str = "fit", seconds: float = 4.0,
    late_stamp_ns: int = 0,
) -> Path:  # fmt: skip
    """Write a recording.

    Args:
        path: the MCAP file.
        seed: of motion and noise.
        reality: properties of robot and logger.
        role: role of the recording.
        seconds: duration, s.
        late_stamp_ns: error of one command stamp in the middle, ns.
    """
    motion = simulate(seed, reality, seconds)
    rng = np.random.default_rng(1000 + seed)
    # States are sampled within a command period, not at the time of a command.
    first = 0.37 * reality.state_period
    stamp = np.arange(first, seconds - 2 * STEP, reality.state_period)

    def at(signal: str, late: float = 0.0) -> np.ndarray:
        return np.interp(stamp - late, motion["time"], motion[signal])

    position = at("position") + reality.noise * rng.standard_normal(len(stamp))
    velocity = effort = None
    if reality.velocity == "sensor":
        velocity = at("velocity") + 0.002 * rng.standard_normal(len(stamp))
    elif reality.velocity == "differenced":
        velocity = np.diff(position, prepend=position[0]) / reality.state_period
        keep = np.exp(-reality.state_period / reality.filtered) if reality.filtered else 0.0
        for k in range(1, len(velocity)):
            velocity[k] = keep * velocity[k - 1] + (1.0 - keep) * velocity[k]
    if reality.effort != "none":
        of = "torque" if reality.effort == "measured" else "demand"
        effort = at(of, reality.effort_late) + 0.01 * rng.standard_normal(len(stamp))
    start = 1_700_000_000_000_000_000
    command_stamp = start + np.rint(motion["stamps"] * 1e9).astype(np.int64)
    command_stamp[len(command_stamp) // 2] += late_stamp_ns
    sent = motion["values"][:, None]
    state_stamp = start + np.rint(stamp * 1e9).astype(np.int64)
    states = JointSeries(
        "/joint_states", ("j1",), state_stamp, state_stamp, position[:, None],
        None if velocity is None else velocity[:, None],
        None if effort is None else effort[:, None],
    )  # fmt: skip
    commands = JointSeries(
        "/joint_commands", ("j1",), command_stamp, command_stamp,
        None if reality.driven else sent, None, sent if reality.driven else None,
    )  # fmt: skip
    write_recording(path, [states, commands], metadata={"role": role})
    return path


def cell(
    folder: Path, reality: Reality, seeds: tuple[int, ...] = (2, 3), seconds: float = 2.5
) -> tuple[Path, list[Path]]:
    """Write the model and recordings; the last one is held out."""
    folder.mkdir(parents=True, exist_ok=True)
    model = folder / "model.xml"
    model.write_text(MODEL.format(actuator=MOTOR if reality.driven else SERVO), "utf-8")
    roles = ["fit"] * (len(seeds) - 1) + ["held_out"]
    return model, [
        record(folder / f"r{seed}.mcap", seed, reality, role=role, seconds=seconds)
        for seed, role in zip(seeds, roles, strict=True)
    ]
