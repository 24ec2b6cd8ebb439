"""Compiled servos, motors and joint loads of robots in other engines.

The engine simulates the mechanics (:mod:`engine_drake`, :mod:`engine_bullet`). This module computes
joint efforts from setpoints, and forces that the engine lacks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from cell import BETWEEN, Cell
from numba import njit
from plant import Hidden
from robots import Robot
from setpoints import FINE

AXIS = np.dtype(
    [(name, np.float64) for name in (
        "kp", "kv", "peak", "rate", "dead", "bias", "late", "gain", "limit", "stall", "free",
        "keep", "count", "drag", "offset", "sine", "cosine", "harmonic", "spring", "preload",
        "push", "start", "end", "coulomb", "excess", "slow", "warm", "warming", "mean", "wave",
        "cross",
    )]
)  # fmt: skip
"""Parameters of one joint: servo, motor, load; ``rate`` per sample of the servo."""

MEMORY = np.dtype(
    [(name, np.float64) for name in ("read", "slope", "held", "applied", "waiting", "effort")]
    + [("due", np.int64)]
)  # fmt: skip
"""State of one joint's servo and motor."""

TIMING = np.dtype(
    [("mode", np.int64), ("between", np.int64), ("tick", np.int64), ("every", np.int64),
     ("phase", np.int64), ("waits", np.int64), ("slope_keep", np.float64), ("step", np.float64)]
)  # fmt: skip
"""Timing of all servos: ``every``, ``phase`` and ``waits`` in steps of the engine."""


def axes_of(robot: Robot, cell: Cell, real: Hidden, step: float) -> np.ndarray:
    """(joints,) records of :data:`AXIS`."""
    n = len(robot.joints)
    rows = np.zeros(n, AXIS)

    def h(effect: str, name: str, neutral: float = 0.0) -> np.ndarray:
        return real.get(effect, name, n, neutral)

    for i, j in enumerate(robot.joints):
        rows[i]["kp"], rows[i]["kv"], rows[i]["peak"] = j.kp, j.kv, j.effort
        rows[i]["coulomb"] = j.friction
    rows["kp"] *= 1 + h("controller_gain", "stiffness_error")
    rows["kv"] *= 1 + h("controller_gain", "damping_error")
    rows["rate"] = h("rate_limit", "rate", np.inf) * cell.servo_period
    rows["dead"] = h("dead_zone", "width")
    rows["bias"] = h("encoder_bias", "bias") * h("encoder_bias", "in_loop")
    rows["late"] = h("command_delay", "delay") + cell.transport
    rows["gain"] = 1 + h("torque_constant", "relative_error")
    rows["limit"] = h("torque_saturation", "limit", np.inf)
    rows["stall"] = h("torque_speed_limit", "stall", np.inf)
    rows["free"] = h("torque_speed_limit", "no_load_speed", np.inf)
    lag = h("actuator_lag", "time_constant")
    rows["keep"] = np.where(lag > 0, np.exp(-step / np.maximum(lag, 1e-6)), 0.0)
    rows["count"] = cell.encoder
    rows["drag"] = h("quadratic_drag", "coefficient")
    rows["offset"] = h("asymmetric_friction", "offset")
    rows["sine"], rows["cosine"] = h("cogging", "sine"), h("cogging", "cosine")
    rows["harmonic"] = h("cogging", "harmonic", 1.0)
    rows["spring"], rows["preload"] = h("joint_spring", "stiffness"), h("joint_spring", "preload")
    rows["push"], rows["start"] = h("external_force", "effort"), h("external_force", "start")
    rows["end"] = rows["start"] + h("external_force", "duration")
    for effect in ("coulomb_friction", "asymmetric_friction", "stribeck_friction"):
        rows["coulomb"] += h(effect, "coulomb")
    rows["excess"] = h("stribeck_friction", "stiction_excess")
    rows["slow"] = h("stribeck_friction", "stribeck_velocity", 1.0)
    rows["warm"] = h("thermal_friction", "excess")
    rows["warming"] = h("thermal_friction", "warm_up_time", 1.0)
    for name, part in (("mean", "mean"), ("wave", "sine"), ("cross", "cosine")):
        rows[name] = h("position_dependent_friction", part)
    return rows


def timing_of(robot: Robot, cell: Cell, step: float) -> np.ndarray:
    """(1,) record of :data:`TIMING`."""
    row = np.zeros(1, TIMING)
    row["mode"] = ("position", "velocity").index(robot.mode)
    row["between"] = BETWEEN.index(cell.between)
    row["tick"] = round(cell.command_period / FINE)
    row["every"] = round(cell.servo_period / step)
    row["phase"] = int(cell.servo_phase / step)
    row["waits"] = round(cell.computing * cell.servo_period / step)
    row["slope_keep"] = -1.0
    if cell.slope_cutoff > 0.0:
        row["slope_keep"] = 1.0 / (1.0 + 2 * np.pi * cell.slope_cutoff * cell.servo_period)
    row["step"] = step
    return row


@njit(cache=True)
def _wanted(reference: Any, joint: int, t: float, timing: Any) -> float:
    """Return the setpoint of a servo at ``t`` s."""
    last = len(reference) - 1
    x = min(max(t / 1e-3 + 1e-7, 0.0), float(last))
    row = int(x)
    if timing.between == 1:
        after = min(row + 1, last)
        return float((1 - x + row) * reference[row, joint] + (x - row) * reference[after, joint])
    row -= row % timing.tick
    here = reference[row, joint]
    if timing.between == 0:
        return float(here)
    before = reference[max(row - timing.tick, 0), joint]
    return float(before + (here - before) * (x - row) / timing.tick)


@njit(cache=True)
def _within(x: float, bound: float) -> float:
    return min(max(x, -bound), bound)


@njit(cache=True)
def drive(
    k: int, fresh: bool, timings: Any, axes: Any, memory: Any, reference: Any, q: Any, motor: Any,
    speed: Any, made: Any, total: Any, level: Any,
) -> None:  # fmt: skip
    """Compute one step of all joints: motor effort, total effort, and dry friction level."""
    timing = timings[0]
    t = k * timing.step
    for i in range(len(axes)):
        a, m = axes[i], memory[i]
        if m.due <= k:
            m.applied = m.waiting
        if (k + timing.phase) % timing.every == 0:
            read = motor[i] + a.bias
            if a.count > 0.0:
                read = np.floor(read / a.count + 0.5) * a.count
            if timing.slope_keep < 0.0:
                m.slope = speed[i]
            else:
                change = (read - m.read) / (timing.every * timing.step)
                m.slope = timing.slope_keep * m.slope + (1 - timing.slope_keep) * change
            m.read = read
            m.held += _within(_wanted(reference, i, t - a.late, timing) - m.held, a.rate)
            if timing.mode == 0:
                error = m.held - read
                demand = a.kp * (error - _within(error, a.dead)) - a.kv * m.slope
            else:
                demand = a.kv * (m.held - _within(m.held, a.dead) - m.slope)
            m.waiting, m.due = _within(demand, a.peak), k + timing.waits
            if timing.waits == 0:
                m.applied = m.waiting
        effort = _within(m.applied * a.gain, a.limit)
        if np.isfinite(a.stall):
            top = a.stall * min(max(1 - speed[i] / a.free, 0.0), 1.0)
            bottom = a.stall * min(max(1 + speed[i] / a.free, 0.0), 1.0)
            effort = min(max(effort, -bottom), top)
        m.effort = effort if fresh else a.keep * m.effort + (1 - a.keep) * effort
        made[i] = m.effort
        load = a.preload - a.spring * q[i] - a.drag * speed[i] * abs(speed[i]) - a.offset
        load += a.sine * np.sin(a.harmonic * motor[i]) + a.cosine * np.cos(a.harmonic * motor[i])
        if a.start <= t < a.end:
            load += a.push
        total[i] = m.effort + load
        dry = a.coulomb + a.excess * np.exp(-((speed[i] / a.slow) ** 2))
        dry += a.warm * np.exp(-max(t, 0.0) / a.warming)
        dry += a.mean + a.wave * np.sin(q[i]) + a.cross * np.cos(q[i])
        level[i] = max(dry, 1e-9)
