"""Compiled part of the plant: drive, transmission, friction, contact and integrator.

These terms are computed at 40 kHz. Mass matrix and bias effort come from Pinocchio at 20 kHz, with
their time derivatives. All units are SI; on slides N*m means N.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

DRIVES = {"position": 0, "velocity": 1, "effort": 2}
OUTSIDE_KINDS = ("none", "magnetic_latch", "sticky_patch", "periodic_shaker", "loose_cable")

PARAMETERS = np.dtype(
    [(name, np.float64) for name in (
        "kp", "kv", "peak", "gain_p", "gain_v", "constant", "limit", "stall", "free_speed",
        "lag_keep", "rate", "dead", "cog_s", "cog_c", "cog_n", "armature", "viscous", "drag",
        "coulomb", "offset", "stiction", "v_stribeck", "load_mu", "pre_level", "pre_x", "warm",
        "warm_time", "pos_m", "pos_s", "pos_c", "spring", "preload", "coupling", "push",
        "push_at", "push_end", "gap", "tooth", "tooth_damping", "loop_bias",
    )] + [("delay", np.int64), ("soft", np.int64)]
)  # fmt: skip
"""Parameters of one joint: nominal values with hidden effects; ``delay`` and ``rate`` in steps."""

STATE = np.dtype(
    [(name, np.float64) for name in
     ("q", "v", "theta", "omega", "bristle", "pre_z", "held", "drive")]
)  # fmt: skip
"""State of one joint: link, motor, two bristles, rate limiter and drive."""

CHAIN = np.dtype([("slide", np.int64), ("origin", np.float64, 3), ("axis", np.float64, 3)])
CONTACT = np.dtype(
    [("on", np.int64), ("normal", np.float64, 3), ("height", np.float64), ("radius", np.float64),
     ("tip", np.float64, 3), ("stiffness", np.float64), ("damping", np.float64),
     ("friction", np.float64), ("creep", np.float64)]
)  # fmt: skip
"""A sphere at ``tip`` in the last link's frame against the plane normal . x = height."""

OUTSIDE = np.dtype(
    [("kind", np.int64), ("joint", np.int64), ("at", np.float64), ("width", np.float64),
     ("size", np.float64)]
)  # fmt: skip

YIELD = 2e-4
"""Presliding displacement of the bristles of dry friction, rad."""


def chain_row(joint: Any) -> np.ndarray:
    """Return a joint's geometry as a record of :data:`CHAIN`."""
    return np.array((int(joint.slide), joint.origin, joint.axis), CHAIN)


@njit(cache=True, inline="always")
def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


@njit(cache=True)
def outside_force(force: Any, t: float, q: float, v: float) -> float:
    """Return forces that are not in the catalogue."""
    x = (q - force.at) / force.width
    if force.kind == 1:  # a magnet that pulls towards one angle
        return -force.size * x * np.exp(0.5 - x * x / 2)
    if force.kind == 2:  # an interval with high friction
        return -force.size * np.tanh(v / 0.02) * np.exp(-((x / 2) ** 2))
    if force.kind == 3:  # a vibration source
        return force.size * np.sin(2 * np.pi * 1.7 * t) if t % 4.0 > 2.6 else 0.0
    if force.kind == 4:  # a cable that pulls tight in one direction only
        return -3 * force.size * max(q - force.at - 0.1, 0.0) / 0.1
    return 0.0


@njit(cache=True)
def _touch(contact: Any, chain: Any, state: Any, out: Any, axes: Any, origins: Any) -> float:
    """Add the contact's generalized force to ``out``; returns the normal force, N.

    Normal: a linear spring and damper that never pull, N = max(0, k depth + b d(depth)/dt), while
    depth > 0. Tangential: a layer that creeps up to Coulomb's level, c v / (1 + x^4)^(1/4) against
    the velocity v of the link's point in the middle of the overlap, with x = c |v| / (mu N).
    """
    n = len(chain)
    r = np.eye(3)
    at = np.zeros(3)
    for i in range(n):
        at = at + r @ chain[i].origin
        origins[i] = at
        axis = chain[i].axis
        axes[i] = r @ axis
        if chain[i].slide:
            at = at + axes[i] * state[i].q
        else:
            c, s = np.cos(state[i].q), np.sin(state[i].q)
            turn = np.empty((3, 3))
            for a in range(3):
                for b in range(3):
                    turn[a, b] = axis[a] * axis[b] * (1 - c) + (c if a == b else 0.0)
            turn[0, 1] -= axis[2] * s
            turn[0, 2] += axis[1] * s
            turn[1, 0] += axis[2] * s
            turn[1, 2] -= axis[0] * s
            turn[2, 0] -= axis[1] * s
            turn[2, 1] += axis[0] * s
            r = r @ turn
    center = at + r @ contact.tip
    normal = contact.normal
    depth = contact.radius + contact.height - np.dot(normal, center)
    if depth <= 0.0:
        return 0.0
    point = center - normal * (contact.radius - depth / 2)
    velocity = np.zeros(3)
    for i in range(n):
        if chain[i].slide:
            velocity += axes[i] * state[i].v
        else:
            velocity += np.cross(axes[i], point - origins[i]) * state[i].v
    along = np.dot(normal, velocity)
    push = max(contact.stiffness * depth - contact.damping * along, 0.0)
    slide = velocity - along * normal
    level = max(contact.friction * push, 1e-9)
    over = contact.creep * np.sqrt(np.dot(slide, slide)) / level
    force = push * normal - contact.creep / (1 + over**4) ** 0.25 * slide
    for i in range(n):
        if chain[i].slide:
            out[i] += np.dot(axes[i], force)
        else:
            out[i] += np.dot(np.cross(axes[i], point - origins[i]), force)
    return push


@njit(cache=True)
def _solve(a: Any, b: Any) -> None:
    """Solve a x = b in place by Cholesky; ``a`` is symmetric, its lower half is overwritten."""
    n = len(b)
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(total) if i == j else total / a[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]


@njit(cache=True)
def advance(
    at: int, substeps: int, step: float, per_tick: int, mode: int, looped: bool,
    p: Any, chain: Any, contacts: Any, forces: Any, states: Any, fresh: bool, mass: Any,
    bias: Any, q: Any, v: Any, reference: Any, gravity: Any, sent: Any, position: Any,
    velocity: Any, effort: Any, acted: Any, touch: Any,
) -> None:  # fmt: skip
    """Compute row ``at`` of the record and the ``substeps`` to the next, for every recording.

    The first of ``mass`` (upper half) and ``bias`` hold at the first substep, the second a record
    before, and they go on as they went; nothing was before where ``fresh``. ``q`` and ``v`` are
    where Pinocchio is asked next. ``sent`` is filled by the outer loop where ``looped``.
    """
    n = len(p)
    contact, force = contacts[0], forces[0]
    drive, link = np.empty(n), np.empty(n)
    motor, friction, through = np.empty(n), np.empty(n), np.empty(n)
    inertia, axes, origins = np.empty((n, n)), np.empty((n, 3)), np.empty((n, 3))
    for r in range(len(states)):
        state = states[r]
        if fresh:
            mass[1, r], bias[1, r] = mass[0, r], bias[0, r]
        for k in range(at * substeps, (at + 1) * substeps):
            t = k * step
            ahead = k / substeps - at
            first = k == at * substeps
            tick = k // per_tick
            for i in range(n):
                j, s = p[i], state[i]
                # The recorded encoder is on the link; the servo uses the motor position.
                if first:
                    position[at, r, i], velocity[at, r, i] = s.q, s.v
                motor_q, motor_v = (s.theta, s.omega) if j.soft else (s.q, s.v)
                if looped and k % per_tick == 0:
                    sent[tick, r, i] = (
                        gravity[tick, r, i] + j.kp * (reference[tick, r, i] - s.q) - j.kv * s.v
                    )
                u = sent[max(k - j.delay, 0) // per_tick, r, i]
                if mode == 2:
                    u -= _clip(u, -j.dead, j.dead)
                else:
                    s.held += _clip(u - s.held, -j.rate, j.rate)
                    u = s.held
                    if mode == 0:
                        error = u - (motor_q + j.loop_bias)
                        error -= _clip(error, -j.dead, j.dead)
                        u = j.gain_p * error - j.gain_v * motor_v
                    else:
                        u = j.gain_v * (u - _clip(u, -j.dead, j.dead) - motor_v)
                u = _clip(_clip(u, -j.peak, j.peak) * j.constant, -j.limit, j.limit)
                if np.isfinite(j.stall):
                    top = j.stall * _clip(1 - motor_v / j.free_speed, 0.0, 1.0)
                    bottom = -j.stall * _clip(1 + motor_v / j.free_speed, 0.0, 1.0)
                    u = _clip(u, bottom, top)
                if k > 0:
                    u += j.lag_keep * (s.drive - u)
                s.drive = u
                drive[i] = u
            for i in range(n):
                j, s = p[i], state[i]
                motor_q, motor_v = (s.theta, s.omega) if j.soft else (s.q, s.v)
                delivered = drive[i] + (j.coupling * drive[i - 1] if i else 0.0)
                if first:
                    effort[at, r, i] = delivered
                s.pre_z += step * (motor_v - abs(motor_v) * s.pre_z / j.pre_x)
                motor[i] = (
                    delivered
                    - j.viscous * motor_v
                    - j.drag * motor_v * abs(motor_v)
                    - j.offset
                    + j.cog_s * np.sin(j.cog_n * motor_q)
                    + j.cog_c * np.cos(j.cog_n * motor_q)
                    - j.pre_level * s.pre_z / j.pre_x
                )
                load = bias[0, r, i] + ahead * (bias[0, r, i] - bias[1, r, i])
                level = j.coulomb + j.load_mu * abs(load)
                if j.stiction != 0.0:
                    level += j.stiction * np.exp(-((motor_v / j.v_stribeck) ** 2))
                if j.warm != 0.0:
                    level += j.warm * np.exp(-t / j.warm_time)
                level += j.pos_m + j.pos_s * np.sin(s.q) + j.pos_c * np.cos(s.q)
                level = max(level, 1e-9)
                # LuGre friction; the bristle is damped so that it does not oscillate.
                rate_z = motor_v - abs(motor_v) * s.bristle / YIELD
                s.bristle = _clip(s.bristle + step * rate_z, -YIELD, YIELD)
                friction[i] = level * s.bristle / YIELD
                friction[i] += 0.7 * np.sqrt(level / YIELD * j.armature) * rate_z
                link[i] = j.preload - j.spring * s.q - load
                if j.push_at <= t < j.push_end:
                    link[i] += j.push
                for m in range(i + 1):
                    inertia[i, m] = (1 + ahead) * mass[0, r, m, i] - ahead * mass[1, r, m, i]
                if j.soft:
                    twist = s.theta - s.q
                    stretch = twist - _clip(twist, -j.gap / 2, j.gap / 2)
                    through[i] = j.tooth * stretch
                    if stretch != 0.0 or j.gap == 0.0:
                        through[i] += j.tooth_damping * (s.omega - s.v)
                    link[i] += through[i]
                else:
                    inertia[i, i] += j.armature
                    link[i] += motor[i] - friction[i]
            if force.kind:
                s = state[force.joint]
                pull = outside_force(force, t, s.q, s.v)
                link[force.joint] += pull
                if first:
                    acted[at, r] = pull
            if contact.on:
                push = _touch(contact, chain, state, link, axes, origins)
                if first:
                    touch[at, r] = push
            _solve(inertia, link)
            for i in range(n):
                j, s = p[i], state[i]
                s.v += step * link[i]
                s.q += step * s.v
                if j.soft:
                    s.omega += step * (motor[i] - friction[i] - through[i]) / j.armature
                    s.theta += step * s.omega
                else:
                    s.omega, s.theta = s.v, s.q
        mass[1, r], bias[1, r] = mass[0, r], bias[0, r]
        q[r], v[r] = state["q"], state["v"]
