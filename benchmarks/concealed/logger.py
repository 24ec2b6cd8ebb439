"""Simulate a logger of a real cell, with dropped and late messages and jitter; writes MCAP.

It converts traces of any plant to the files that a real recorder would write.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from cases import EPOCH_NS, SCHEMA, messages
from mcap.writer import CompressionType, Writer
from plant import Hidden
from robots import Robot

DRIVER = 1e-3
"""Time between the readings from which a driver computes its velocity, s."""
RATES = (20.0, 50.0, 100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)
RATE_SHARES = (0.05, 0.1, 0.2, 0.15, 0.2, 0.15, 0.1, 0.05)


@dataclass(frozen=True)
class Logger:
    """Properties of a recorder.

    Attributes:
        rate: rate of state messages, Hz.
        jitter: standard deviation of the time at which a state is read and stamped, s.
        latency: mean of the exponential time from the reading to its stamp, s; 0 for none.
        late_share, late_by: fraction of messages with a late stamp, and largest delay, s.
        drop_share, command_drop_share: fraction of missing messages.
        hole: length of a gap without states in one of the recordings, s; 0 for none.
        noise, count: noise and resolution of position readings, rad or m.
        velocity: none, sensor, differenced or filtered (``velocity_cutoff``, Hz).
        effort: none, sensor, or command (what the servo demands).
    """

    rate: float
    jitter: float
    latency: float
    late_share: float
    late_by: float
    drop_share: float
    command_drop_share: float
    hole: float
    noise: float
    count: float
    velocity: str
    velocity_cutoff: float
    effort: str

    def facts(self) -> list[dict[str, Any]]:
        """Return properties that a diagnosis may report correctly besides hidden effects."""
        if self.latency == 0.0:
            return []
        return [{"effect": "sensor_delay", "joint": None, "parameters": {"delay": self.latency}}]

    def told(self) -> dict[str, Any]:
        """The attributes, for the truth file."""
        return asdict(self)


def draw_logger(rng: np.random.Generator, *, effort_sensor: bool = False) -> Logger:
    """Draw a logger; with an effort sensor if the hidden effect is visible only there."""
    kinds = ("none", "sensor", "differenced", "filtered")
    velocity = str(rng.choice(kinds, p=(0.4, 0.2, 0.2, 0.2)))
    effort = str(rng.choice(("none", "sensor", "command"), p=(0.6, 0.25, 0.15)))
    latent, late, drops, hole = (bool(x) for x in rng.random(4) < (0.3, 0.3, 0.3, 0.15))
    return Logger(
        rate=float(rng.choice(RATES, p=RATE_SHARES)),
        jitter=float(rng.choice((0.0, 2e-5, 2e-4, 8e-4))),
        latency=float(rng.uniform(2e-4, 1.2e-3)) if latent else 0.0,
        late_share=float(rng.uniform(0.002, 0.02)) if late else 0.0,
        late_by=float(rng.uniform(2e-3, 8e-3)),
        drop_share=float(rng.uniform(0.002, 0.04)) if drops else 0.0,
        command_drop_share=float(rng.uniform(0.001, 0.005)) if drops else 0.0,
        hole=float(rng.uniform(0.05, 0.3)) if hole else 0.0,
        noise=float(rng.choice((1e-5, 5e-5, 2e-4))),
        count=float(2 * np.pi / rng.choice((4096, 16384, 65536, 2**19))),
        velocity=velocity,
        velocity_cutoff=float(rng.uniform(5.0, 40.0)),
        effort="sensor" if effort_sensor else effort,
    )


@dataclass
class Traces:
    """One recording with ideal sensors and buses.

    Attributes:
        period: time between rows of ``position``, ``velocity``, ``effort``, ``demand`` (rows,
            joints), s.
        commands: (commands, joints), one every ``command_period`` s.
    """

    period: float
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    demand: np.ndarray
    command_period: float
    commands: np.ndarray

    @property
    def seconds(self) -> float:
        """Length."""
        return self.period * (len(self.position) - 1)

    def at(self, name: str, time: np.ndarray) -> np.ndarray:
        """(times, joints) of a trace, interpolated."""
        trace = getattr(self, name)
        x = np.clip(time / self.period, 0.0, len(trace) - 1)
        before = np.minimum(x.astype(int), len(trace) - 2)
        part = (x - before)[:, None]
        out: np.ndarray = trace[before] * (1 - part) + trace[before + 1] * part
        return out


def read_at(stamps: np.ndarray, hidden: Hidden) -> np.ndarray:
    """Times of readings, s, whose ``stamps`` include sensor delay and clock drift."""
    late: np.ndarray = stamps * (1 - hidden.robot("clock_drift", "drift"))
    return late - hidden.robot("sensor_delay", "delay")


def driver_velocity(traces: Traces, logger: Logger, time: np.ndarray) -> np.ndarray:
    """(times, joints) velocity of a driver, from differences of quantized positions."""
    grid = np.arange(0.0, traces.seconds, DRIVER)
    counts = np.round(traces.at("position", grid) / logger.count) * logger.count
    if logger.velocity == "differenced":
        over = 8
        made = np.zeros_like(counts)
        made[over:] = (counts[over:] - counts[:-over]) / (over * DRIVER)
    else:
        keep = np.exp(-2 * np.pi * logger.velocity_cutoff * DRIVER)
        made = np.diff(counts, axis=0, prepend=counts[:1]) / DRIVER
        for k in range(1, len(made)):
            made[k] = keep * made[k - 1] + (1 - keep) * made[k]
    out: np.ndarray = made[np.clip((time / DRIVER).astype(int), 0, len(made) - 1)]
    return out


def stamped(
    traces: Traces, hidden: Hidden, logger: Logger, holed: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(states,) s of stamps and of readings."""
    stamps = np.arange(0.0, traces.seconds, 1.0 / logger.rate)
    stamps = stamps + rng.uniform(0.0, 1.0 / logger.rate)
    stamps += logger.jitter * rng.standard_normal(len(stamps))
    late = logger.latency * rng.exponential(1.0, len(stamps))
    late += logger.late_by * rng.random(len(stamps)) * (rng.random(len(stamps)) < logger.late_share)
    taken = read_at(stamps, hidden)
    stamps = _in_order(stamps + late)
    kept = (taken >= 0.0) & (taken < traces.seconds) & (stamps >= 0.0)
    kept &= rng.random(len(stamps)) >= logger.drop_share
    if holed and logger.hole:
        start = rng.uniform(1.0, traces.seconds - 1.0)
        kept &= (stamps < start) | (stamps >= start + logger.hole)
    return stamps[kept], taken[kept]


def _in_order(stamps: np.ndarray) -> np.ndarray:
    """Make stamps monotonic; messages that wait for a late one are 1 us apart."""
    out = np.maximum.accumulate(stamps)
    for k in range(1, len(out)):
        out[k] = max(out[k], out[k - 1] + 1e-6)
    return out


def write(
    path: Path, robot: Robot, traces: Traces, hidden: Hidden, logger: Logger,
    trial: dict[str, str], holed: bool, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Log one recording as MCAP."""
    names = [j.name for j in robot.joints]
    stamps, taken = stamped(traces, hidden, logger, holed, rng)
    position = traces.at("position", taken)
    position += logger.noise * rng.standard_normal(position.shape)
    fields = {"position": np.round(position / logger.count) * logger.count}
    if logger.velocity == "sensor":
        fields["velocity"] = traces.at("velocity", taken)
        fields["velocity"] += 0.01 * rng.standard_normal(position.shape)
    elif logger.velocity != "none":
        fields["velocity"] = driver_velocity(traces, logger, taken)
    if logger.effort != "none":
        which = "effort" if logger.effort == "sensor" else "demand"
        peak = np.array([j.effort for j in robot.joints])
        fields["effort"] = traces.at(which, taken)
        if which == "effort":
            fields["effort"] += 2e-3 * peak * rng.standard_normal(position.shape)
    states = EPOCH_NS + np.round(stamps * 1e9).astype(np.int64)
    count = len(traces.commands)
    there = rng.random(count) >= logger.command_drop_share
    there[0] = True
    sent = np.round(np.arange(count) * traces.command_period * 1e9).astype(np.int64)[there]
    sent += EPOCH_NS
    commands = messages(names, sent, {robot.mode: traces.commands[there]})
    rows = [(int(s), 0, m) for s, m in zip(sent, commands, strict=True)]
    rows += [(int(s), 1, m) for s, m in zip(states, messages(names, states, fields), strict=True)]
    rows.sort(key=lambda row: row[:2])
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", SCHEMA.encode())
        topics = ("/joint_commands", "/joint_states")
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        writer.add_metadata("trial", trial)
        for stamp, which_channel, data in rows:
            writer.add_message(channels[which_channel], stamp, data.tobytes(), stamp)
        writer.finish()
