"""Compiled plant of sampled cells: rigid bodies, sampled servos, motors, friction, integrator.

Rigid-body terms are summed over bodies in the base frame (recursive accelerations, Jacobians of the
centres of mass), without Pinocchio or a physics engine. SI units; on slides N*m means N.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from cell_friction import ELEMENTS, friction_effort
from kernel import outside_force
from numba import njit

JOINT = np.dtype(
    [(name, np.float64) for name in (
        "kp", "kv", "peak", "gain_p", "gain_v", "constant", "limit", "stall", "free_speed", "lag",
        "rate", "dead", "cog_s", "cog_c", "cog_n", "armature", "viscous", "drag", "coulomb",
        "offset", "stiction", "v_stribeck", "load_mu", "yield_at", "pre_level", "pre_x", "warm",
        "warm_time", "pos_m", "pos_s", "pos_c", "spring", "preload", "coupling", "push", "push_at",
        "push_end", "gap", "tooth", "tooth_damping", "loop_bias", "delay", "encoder", "back_emf",
    )] + [("soft", np.int64), ("law", np.int64)]
)  # fmt: skip
"""Parameters of one joint: nominal values, background and hidden effects; ``delay`` in s."""

STATE = np.dtype(
    [(name, np.float64) for name in (
        "q", "v", "theta", "omega", "pre_z", "held", "applied", "pending", "read", "slope",
        "current", "integral", "lagged",
    )] + [("z", np.float64, ELEMENTS), ("slip", np.float64, ELEMENTS)]
)  # fmt: skip
"""State of one joint: link, motor, servo, current loop and friction."""

SERVO = np.dtype(
    [("mode", np.int64), ("between", np.int64), ("tick", np.int64), ("steps", np.int64),
     ("phase", np.int64), ("compute", np.int64), ("host", np.int64), ("slope_keep", np.float64),
     ("bandwidth", np.float64), ("electrical", np.float64)]
)  # fmt: skip
"""Parameters of all servos: ``tick`` and ``host`` in rows of the setpoint; ``steps``, ``phase`` and
``compute`` in steps of the integrator; ``bandwidth`` (rad/s) and ``electrical`` (s) of the motors'
current loops, 0 for an ideal motor."""

LINK = np.dtype([("slide", np.int64), ("origin", np.float64, 3), ("axis", np.float64, 3)])
BODY = np.dtype(
    [("joint", np.int64), ("mass", np.float64), ("center", np.float64, 3),
     ("inertia", np.float64, (3, 3))]
)  # fmt: skip
"""A rigid body on a joint's link: centre of mass and inertia about it in the link's frame."""

SETTLE = 1.0
"""Time before a recording in which the robot comes to rest at the first setpoint, s."""


@njit(cache=True, inline="always")
def _clip(x: float, low: float, high: float) -> float:
    return min(max(x, low), high)


@njit(cache=True, error_model="numpy")
def _cross(a: Any, b: Any, out: Any) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, inline="always")
def _dot(a: Any, b: Any) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@njit(cache=True, error_model="numpy")
def rigid_terms(
    links: Any, bodies: Any, gravity: Any, q: Any, v: Any, mass: Any, bias: Any, work: Any
) -> None:
    """Fill ``mass`` (n, n) and ``bias`` (n,): inertia, and effort of gravity and velocities.

    ``work`` is of :func:`scratch`.
    """
    turn, frames, room = work
    n = len(links)
    mass[:] = 0.0
    bias[:] = 0.0
    # Rows of a frame: origin, axis, angular velocity, angular and linear acceleration, scratch.
    frames[0, :] = 0.0
    turn[0] = np.eye(3)
    for c in range(3):
        frames[0, 4, c] = -gravity[c]
    for i in range(n):
        link, before, here = links[i], frames[i], frames[i + 1]
        for c in range(3):
            here[1, c] = 0.0
            here[5, c] = 0.0
            for d in range(3):
                here[1, c] += turn[i, c, d] * link.axis[d]
                here[5, c] += turn[i, c, d] * link.origin[d]
            if link.slide:
                here[5, c] += here[1, c] * q[i]
            here[0, c] = before[0, c] + here[5, c]
            here[2, c], here[3, c] = before[2, c], before[3, c]
        _cross(before[2], here[5], here[6])
        _cross(before[2], here[6], here[7])
        _cross(before[3], here[5], here[6])
        for c in range(3):
            here[4, c] = before[4, c] + here[6, c] + here[7, c]
        _cross(before[2], here[1], here[6])
        for c in range(3):
            if link.slide:
                here[4, c] += 2 * here[6, c] * v[i]
            else:
                here[3, c] += here[6, c] * v[i]
                here[2, c] += here[1, c] * v[i]
        if link.slide:
            turn[i + 1] = turn[i]
        else:
            cosine, sine, a = np.cos(q[i]), np.sin(q[i]), here[1]
            for d in range(3):
                x, y, z = turn[i, 0, d], turn[i, 1, d], turn[i, 2, d]
                along = (a[0] * x + a[1] * y + a[2] * z) * (1 - cosine)
                turn[i + 1, 0, d] = cosine * x + sine * (a[1] * z - a[2] * y) + along * a[0]
                turn[i + 1, 1, d] = cosine * y + sine * (a[2] * x - a[0] * z) + along * a[1]
                turn[i + 1, 2, d] = cosine * z + sine * (a[0] * y - a[1] * x) + along * a[2]
    _add_bodies(links, bodies, mass, bias, turn, frames, room)
    for i in range(n):
        for j in range(i):
            mass[j, i] = mass[i, j]


@njit(cache=True, error_model="numpy")
def _add_bodies(
    links: Any, bodies: Any, mass: Any, bias: Any, turn: Any, frames: Any, room: Any
) -> None:  # fmt: skip
    """Inertia and effort of every body, on the joints that carry it (lower half)."""
    n = len(links)
    moves, turns = room[8 : 8 + n], room[8 + n :]
    world = room[:3]
    at, spin, force, moment, scratch = room[3], room[4], room[5], room[6], room[7]
    for b in range(len(bodies)):
        body = bodies[b]
        k = body.joint
        r, here = turn[k + 1], frames[k + 1]
        for c in range(3):
            at[c] = 0.0
            for d in range(3):
                at[c] += r[c, d] * body.center[d]
                world[c, d] = 0.0
                for e in range(3):
                    for f in range(3):
                        world[c, d] += r[c, e] * body.inertia[e, f] * r[d, f]
        _cross(here[2], at, scratch)
        _cross(here[2], scratch, force)
        _cross(here[3], at, scratch)
        for c in range(3):
            force[c] = body.mass * (here[4, c] + scratch[c] + force[c])
            spin[c] = _dot(world[c], here[2])
        _cross(here[2], spin, moment)
        for c in range(3):
            moment[c] += _dot(world[c], here[3])
            at[c] += here[0, c]
        for j in range(k + 1):
            axis = frames[j + 1, 1]
            if links[j].slide:
                for c in range(3):
                    moves[j, c], turns[j, c] = axis[c], 0.0
            else:
                for c in range(3):
                    scratch[c] = at[c] - frames[j + 1, 0, c]
                    turns[j, c] = axis[c]
                _cross(axis, scratch, moves[j])
            bias[j] += _dot(moves[j], force) + _dot(turns[j], moment)
            for c in range(3):
                spin[c] = _dot(world[c], turns[j])
            for i in range(j + 1):
                mass[j, i] += body.mass * _dot(moves[i], moves[j]) + _dot(turns[i], spin)


@njit(cache=True, error_model="numpy")
def scratch(n: int) -> Any:
    """Allocate the work array of :func:`rigid_terms`."""
    return np.empty((n + 1, 3, 3)), np.empty((n + 1, 8, 3)), np.empty((8 + 2 * n, 3))


@njit(cache=True, error_model="numpy")
def asked(sent: Any, joint: int, t: float, between: int, tick: int, fine: float) -> float:
    """Return the setpoint of a servo at ``t`` s: held, interpolated or ramped."""
    x = _clip(t / fine + 1e-7, 0.0, len(sent) - 1.0)
    if between == 1:
        k = min(int(x), len(sent) - 2)
        return float(sent[k, joint] + (x - k) * (sent[k + 1, joint] - sent[k, joint]))
    k = int(x) // tick * tick
    if between == 0:
        return float(sent[k, joint])
    before = sent[max(k - tick, 0), joint]
    return float(before + (x - k) / tick * (sent[k, joint] - before))


@njit(cache=True, error_model="numpy")
def factor(a: Any) -> None:
    """Cholesky factor of a symmetric matrix, in its lower half."""
    n = len(a)
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = np.sqrt(total) if i == j else total / a[j, j]


@njit(cache=True, error_model="numpy")
def solve(a: Any, b: Any) -> None:
    """Solve with a factor of :func:`factor`, in place of ``b``."""
    n = len(b)
    for i in range(n):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]


@njit(cache=True, error_model="numpy")
def _servo(servo: Any, j: Any, s: Any, wanted: float, step: float) -> float:
    """Return the effort that a servo demands at one of its samples; updates its state."""
    motor = s.theta + j.loop_bias
    read = np.round(motor / j.encoder) * j.encoder if j.encoder > 0.0 else motor
    period = servo.steps * step
    if servo.slope_keep < 0.0:  # a servo with a velocity sensor
        s.slope = s.omega
    else:
        s.slope += (1 - servo.slope_keep) * ((read - s.read) / period - s.slope)
    s.read = read
    if servo.mode == 2:
        return float(_clip(wanted - _clip(wanted, -j.dead, j.dead), -j.peak, j.peak))
    s.held += _clip(wanted - s.held, -j.rate * period, j.rate * period)
    if servo.mode == 0:
        error = s.held - read
        error -= _clip(error, -j.dead, j.dead)
        demand = j.gain_p * error - j.gain_v * s.slope
    else:
        demand = j.gain_v * (s.held - _clip(s.held, -j.dead, j.dead) - s.slope)
    return float(_clip(demand, -j.peak, j.peak))


@njit(cache=True, error_model="numpy")
def _delivered(servo: Any, j: Any, s: Any, step: float, start: bool) -> float:
    """Return the effort of a motor for the demand of its servo; updates its state."""
    bound = s.applied
    if servo.bandwidth > 0.0:
        # With resistance 1, current and voltage are in units of effort.
        error = s.applied - s.current
        s.integral += step * servo.bandwidth * error
        voltage = servo.bandwidth * servo.electrical * error + s.integral
        voltage = _clip(voltage, -3.0 * j.peak, 3.0 * j.peak)
        s.current += step / servo.electrical * (voltage - s.current - j.back_emf * s.omega)
        bound = s.current
    effort = _clip(bound * j.constant, -j.limit, j.limit)
    if np.isfinite(j.stall):
        top = j.stall * _clip(1 - s.omega / j.free_speed, 0.0, 1.0)
        bottom = -j.stall * _clip(1 + s.omega / j.free_speed, 0.0, 1.0)
        effort = _clip(effort, bottom, top)
    if j.lag > 0.0 and not start:
        effort += np.exp(-step / j.lag) * (s.lagged - effort)
    s.lagged = effort
    return float(effort)


@njit(cache=True, error_model="numpy")
def _level(j: Any, s: Any, t: float, load: float) -> float:
    """Friction of steady sliding, N*m."""
    level = j.coulomb + j.load_mu * abs(load)
    if j.stiction != 0.0:
        level += j.stiction * np.exp(-((s.omega / j.v_stribeck) ** 2))
    if j.warm != 0.0:
        level += j.warm * np.exp(-max(t, 0.0) / j.warm_time)
    level += j.pos_m + j.pos_s * np.sin(s.q) + j.pos_c * np.cos(s.q)
    return float(max(level, 1e-9))


@njit(cache=True, error_model="numpy")
def _stick(inertia: Any, accel: Any, v: Any, bound: Any, step: float, pull: Any) -> None:
    """Solve set-valued joint friction: efforts ``pull`` within ``bound`` that stop the joints.

    Projected Gauss-Seidel over the velocities at the end of the step; adds to ``accel``.
    """
    n = len(accel)
    column = np.empty((n, n))
    for i in range(n):
        column[i] = 0.0
        column[i, i] = 1.0
        solve(inertia, column[i])
    for _ in range(12):
        for i in range(n):
            if bound[i] <= 0.0:
                continue
            ahead = v[i] + step * accel[i]
            for k in range(n):
                ahead += step * column[k, i] * pull[k]
            pull[i] = _clip(pull[i] - ahead / (step * column[i, i]), -bound[i], bound[i])
    for i in range(n):
        for k in range(n):
            accel[i] += column[k, i] * pull[k]


@njit(cache=True, error_model="numpy")
def run(
    steps: int, every: int, step: float, fine: float, servos: Any, p: Any, links: Any, bodies: Any,
    gravity: Any, forces: Any, state: Any, reference: Any, holding: Any, sent: Any, looped: bool,
    restart: Any, restart_every: int, position: Any, velocity: Any, effort: Any, demand: Any,
    acted: Any, kept: Any,
) -> None:  # fmt: skip
    """One recording: fill the rows of its traces, one per ``every`` steps.

    ``sent`` (rows of the setpoint, joints) is what the servos are sent, filled by the outer loop
    where ``looped``. ``restart`` holds states that are taken over every ``restart_every`` steps;
    where it is empty, the robot settles for ``SETTLE`` s first.
    """
    n = len(p)
    servo, force = servos[0], forces[0]
    mass, inertia, bias = np.empty((n, n)), np.empty((n, n)), np.empty(n)
    link, motor, friction, bound = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    pull, drive, through = np.zeros(n), np.empty(n), np.empty(n)
    wanted = np.zeros(n)
    work = scratch(n)
    q, v = np.empty(n), np.empty(n)
    first = 0 if len(restart) else -round(SETTLE / step)
    per_fine = round(fine / step)
    setvalued = p[0].law == 3
    for k in range(first, steps):
        t = k * step
        if len(restart) and k % restart_every == 0:
            state[:] = restart[k // restart_every]
            pull[:] = 0.0
        if k >= 0 and k % restart_every == 0:
            kept[k // restart_every] = state
        record = k >= 0 and k % every == 0
        for i in range(n):
            q[i], v[i] = state[i].q, state[i].v
        rigid_terms(links, bodies, gravity, q, v, mass, bias, work)
        if looped and k % (servo.host * per_fine) == 0:
            row = max(k // per_fine, 0)
            for i in range(n):
                j, s = p[i], state[i]
                wanted[i] = holding[row, i] + j.kp * (reference[row, i] - s.q) - j.kv * s.v
                sent[row : row + servo.host, i] = wanted[i]
        samples = (k + servo.phase) % servo.steps == 0
        applies = (k + servo.phase - servo.compute) % servo.steps == 0
        for i in range(n):
            j, s = p[i], state[i]
            if not j.soft:
                s.theta, s.omega = s.q, s.v
            if record:
                position[k // every, i], velocity[k // every, i] = s.q, s.v
            if applies and servo.compute > 0:
                s.applied = s.pending
            if samples:
                u = asked(sent, i, t - j.delay, servo.between, servo.tick, fine)
                if looped and k <= 0:
                    u = wanted[i]
                s.pending = _servo(servo, j, s, u, step)
                if servo.compute == 0:
                    s.applied = s.pending
            drive[i] = _delivered(servo, j, s, step, k == first)
        for i in range(n):
            j, s = p[i], state[i]
            delivered = drive[i] + (j.coupling * drive[i - 1] if i else 0.0)
            if record:
                effort[k // every, i], demand[k // every, i] = delivered, s.applied
            s.pre_z += step * (s.omega - abs(s.omega) * s.pre_z / j.pre_x)
            motor[i] = (
                delivered
                - j.viscous * s.omega
                - j.drag * s.omega * abs(s.omega)
                - j.offset
                + j.cog_s * np.sin(j.cog_n * s.theta)
                + j.cog_c * np.cos(j.cog_n * s.theta)
                - j.pre_level * s.pre_z / j.pre_x
            )
            level = _level(j, s, t, bias[i])
            friction[i], bound[i] = 0.0, 0.0
            if setvalued:
                bound[i] = level
            else:
                friction[i] = friction_effort(
                    j.law, level, j.yield_at, j.armature, s.omega, step, s.z, s.slip
                )
            link[i] = j.preload - j.spring * s.q - bias[i]
            if j.push_at <= t < j.push_end:
                link[i] += j.push
            for m in range(n):
                inertia[i, m] = mass[i, m]
            if j.soft:
                twist = s.theta - s.q
                stretch = twist - _clip(twist, -j.gap / 2, j.gap / 2)
                through[i] = j.tooth * stretch
                if stretch != 0.0 or j.gap == 0.0:
                    through[i] += j.tooth_damping * (s.omega - s.v)
                link[i] += through[i]
                free = motor[i] - friction[i] - through[i]
                if setvalued:
                    free += _clip(-s.omega * j.armature / step - free, -bound[i], bound[i])
                    bound[i] = 0.0
                motor[i] = free
            else:
                inertia[i, i] += j.armature
                link[i] += motor[i] - friction[i]
        if force.kind:
            s = state[force.joint]
            extra = outside_force(force, t, s.q, s.v)
            link[force.joint] += extra
            if record:
                acted[k // every] = extra
        factor(inertia)
        solve(inertia, link)
        if setvalued:
            _stick(inertia, link, v, bound, step, pull)
        for i in range(n):
            j, s = p[i], state[i]
            s.v += step * link[i]
            s.q += step * s.v
            if j.soft:
                s.omega += step * motor[i] / j.armature
                s.theta += step * s.omega
            else:
                s.theta, s.omega = s.q, s.v
