"""Plant of blind cases, which is independent of MuJoCo and of the code of pytest_twin.

It uses Pinocchio's rigid-body terms and a semi-implicit integrator at 40 kHz. Elastic transmissions
have separate motor and link positions. Friction has a bristle state (LuGre, Canudas de Wit et al.
1995), while the package fits static curves. The drive has a current lag, and the contact has its
own compliant law.

Friction, transmission, drive, contact and the solution for the accelerations are stepped at 40 kHz
by :mod:`kernel`, compiled. Pinocchio's mass matrix and bias effort are evaluated at 20 kHz and
extrapolated linearly in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from kernel import CONTACT, DRIVES, OUTSIDE, PARAMETERS, STATE, advance, chain_row
from robots import Robot, pinocchio_model

STEP = 2.5e-5
"""s, of the integrator."""
RECORD = 5e-5
"""Time between stored samples and between evaluations of Pinocchio's terms, s."""
TICK = 0.01
"""Time between commands, s."""
RESTART = 0.25
"""Time between complete states that a run stores, s."""


@dataclass
class Hidden:
    """Hidden effects: effect -> joint index (or -1) -> parameters."""

    effects: dict[str, dict[int, dict[str, Any]]] = field(default_factory=dict)

    def get(self, effect: str, name: str, count: int, neutral: float = 0.0) -> np.ndarray:
        """(count,) values of a parameter over the joints."""
        out = np.full(count, neutral)
        for joint, values in self.effects.get(effect, {}).items():
            out[slice(None) if joint < 0 else joint] = values.get(name, neutral)
        return out

    def robot(self, effect: str, name: str, neutral: float = 0.0) -> float:
        """A parameter of the whole robot."""
        return float(self.effects.get(effect, {}).get(-1, {}).get(name, neutral))

    def without(self, effect: str, joint: int) -> Hidden:
        """Return the hidden effects without one of them."""
        kept = {e: {i: p for i, p in at.items() if (e, i) != (effect, joint)}
                for e, at in self.effects.items()}  # fmt: skip
        return Hidden({e: at for e, at in kept.items() if at})


@dataclass
class Motion:
    """Simulated motion of the plant.

    Attributes:
        position, velocity, effort: (samples, recordings, joints) exact sensor readings, one per
            :data:`RECORD`.
        setpoint: (ticks, recordings, joints) commands, one per :data:`TICK`.
        outside: (samples, recordings) force that is not in the catalogue; empty without one.
        touch: (samples, recordings) normal contact force, N; empty without a contact.
        kept: (instants, recordings, joints) complete states, every :data:`RESTART` s.
    """

    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    setpoint: np.ndarray
    outside: np.ndarray
    touch: np.ndarray
    kept: np.ndarray

    def recordings(self, rows: slice | int) -> Motion:
        """Some of the recordings, or one."""
        return Motion(*(a[:, rows] if a.size else a for a in vars(self).values()))


def parameters(robot: Robot, hidden: Hidden, step: float) -> np.ndarray:
    """(joints,) records of :data:`kernel.PARAMETERS`: the nominal robot with hidden effects."""
    n = len(robot.joints)
    j = robot.joints
    p = np.zeros(n, PARAMETERS)

    def h(effect: str, name: str, neutral: float = 0.0) -> np.ndarray:
        return hidden.get(effect, name, n, neutral)

    p["kp"], p["kv"] = [x.kp for x in j], [x.kv for x in j]
    p["peak"] = [x.effort for x in j]
    p["gain_p"] = p["kp"] * (1 + h("controller_gain", "stiffness_error"))
    p["gain_v"] = p["kv"] * (1 + h("controller_gain", "damping_error"))
    p["constant"] = 1 + h("torque_constant", "relative_error")
    p["limit"] = h("torque_saturation", "limit", np.inf)
    p["stall"] = h("torque_speed_limit", "stall", np.inf)
    p["free_speed"] = h("torque_speed_limit", "no_load_speed", np.inf)
    p["lag_keep"] = np.exp(-step / np.maximum(h("actuator_lag", "time_constant"), 1e-9))
    p["rate"] = h("rate_limit", "rate", np.inf) * step
    p["dead"] = h("dead_zone", "width")
    p["cog_s"], p["cog_c"] = h("cogging", "sine"), h("cogging", "cosine")
    p["cog_n"] = h("cogging", "harmonic", 1.0)
    p["armature"] = [x.armature for x in j] + h("armature", "inertia")
    p["viscous"] = [x.damping for x in j] + h("viscous_friction", "coefficient")
    p["drag"] = h("quadratic_drag", "coefficient")
    p["coulomb"] = [x.friction for x in j] + h("coulomb_friction", "coulomb")
    p["coulomb"] += h("asymmetric_friction", "coulomb") + h("stribeck_friction", "coulomb")
    p["offset"] = h("asymmetric_friction", "offset")
    p["stiction"] = h("stribeck_friction", "stiction_excess")
    p["v_stribeck"] = h("stribeck_friction", "stribeck_velocity", 1.0)
    p["load_mu"] = h("load_dependent_friction", "coefficient")
    p["pre_level"] = h("presliding_hysteresis", "coulomb")
    p["pre_x"] = h("presliding_hysteresis", "presliding_distance", 1.0)
    p["warm"], p["warm_time"] = (
        h("thermal_friction", "excess"),
        h("thermal_friction", "warm_up_time", 1.0),
    )
    for name, part in (("pos_m", "mean"), ("pos_s", "sine"), ("pos_c", "cosine")):
        p[name] = h("position_dependent_friction", part)
    p["spring"], p["preload"] = h("joint_spring", "stiffness"), h("joint_spring", "preload")
    p["coupling"] = h("joint_coupling", "ratio")
    p["push"], p["push_at"] = h("external_force", "effort"), h("external_force", "start")
    p["push_end"] = p["push_at"] + h("external_force", "duration", 1.0)
    p["gap"] = h("backlash", "gap")
    elastic = h("joint_elasticity", "stiffness")
    p["soft"] = (p["gap"] > 0) | (elastic > 0)
    p["tooth"] = np.where(elastic > 0, elastic, [x.teeth for x in j])
    p["tooth_damping"] = np.where(
        elastic > 0,
        elastic * h("joint_elasticity", "damping_time"),
        0.6 * np.sqrt(p["tooth"] * p["armature"]),
    )
    p["delay"] = np.round(h("command_delay", "delay") / step)
    p["loop_bias"] = h("encoder_bias", "bias") * h("encoder_bias", "in_loop")
    return p


def rigid_bodies(robot: Robot, hidden: Hidden) -> pin.Model:
    """Return Pinocchio's model of the true robot."""
    scale = {
        i: 1.0 + v["relative_error"]
        for i, v in hidden.effects.get("inertial_parameters", {}).items()
    }
    payload = (hidden.robot("payload", "mass"), hidden.robot("payload", "distance"))
    tilt = pin.rpy.rpyToMatrix(
        hidden.robot("base_tilt", "roll"), hidden.robot("base_tilt", "pitch"), 0.0
    )
    return pinocchio_model(robot, scale, payload, tilt.T @ np.array([0.0, 0.0, -9.81]))


def holding_effort(robot: Robot, reference: np.ndarray) -> np.ndarray:
    """Gravity's effort on the nominal robot at (ticks, recordings, joints) references."""
    model = pinocchio_model(robot, {}, (0.0, 0.0), np.array([0.0, 0.0, -9.81]))
    data = model.createData()
    flat = reference.reshape(-1, reference.shape[-1])
    out = [pin.computeGeneralizedGravity(model, data, q).copy() for q in flat]
    return np.array(out).reshape(reference.shape)


def contact_row(robot: Robot, hidden: Hidden) -> np.ndarray:
    """(1,) record of :data:`kernel.CONTACT`: the nominal contact with hidden effects."""
    row = np.zeros(1, CONTACT)
    c = robot.contact
    if c is not None:
        row["on"] = 1
        row["normal"] = c.normal
        row["height"] = c.height + hidden.robot("contact_offset", "offset")
        row["radius"] = c.radius
        row["tip"] = c.tip
        row["stiffness"] = c.stiffness * (1 + hidden.robot("contact_stiffness", "relative_error"))
        row["damping"] = c.damping * (1 + hidden.robot("contact_damping", "relative_error"))
        row["friction"] = c.friction + hidden.robot("contact_friction", "coefficient")
        row["creep"] = c.creep
    return row


def simulate(
    robot: Robot,
    hidden: Hidden,
    reference: np.ndarray,
    start: np.ndarray,
    *,
    outside: np.ndarray | None = None,
    sent: np.ndarray | None = None,
    restart: np.ndarray | None = None,
    step: float = STEP,
    record: float = RECORD,
) -> Motion:
    """Simulate the plant under references (ticks, recordings, joints), one per :data:`TICK`.

    All recordings are simulated together; ``start`` is (recordings, joints). A position or velocity
    servo follows the references. An effort drive gets the effort of an outer PD loop with gravity
    compensation, which is then the recorded command.

    Args:
        outside: (1,) record of :data:`kernel.OUTSIDE`, a force that is not in the catalogue.
        sent: (ticks, recordings, joints) commands that replace those of the outer loop.
        restart: ``kept`` of another run, from whose states this one is restarted every
            :data:`RESTART` s.
        step, record: replacements of :data:`STEP` and :data:`RECORD`, s.
    """
    ticks, rows, n = reference.shape
    per_tick = round(TICK / step)
    substeps = round(record / step)
    samples = round(ticks * TICK / record)
    p = parameters(robot, hidden, step)
    contact = contact_row(robot, hidden)
    chain = np.array([chain_row(j) for j in robot.joints])
    force = np.zeros(1, OUTSIDE) if outside is None else outside
    model = rigid_bodies(robot, hidden)
    data = [model.createData() for _ in range(rows)]
    mass_of, bias_of = [d.M for d in data], [d.nle for d in data]

    state = np.zeros((rows, n), STATE)
    state["q"] = start - p["loop_bias"]
    state["theta"] = state["q"]
    state["held"] = reference[0]
    q, v = state["q"].copy(), np.zeros((rows, n))
    q_of, v_of, each = list(q), list(v), range(rows)
    # Now, and a record before; None of it before the first.
    mass, bias = np.zeros((2, rows, n, n)), np.zeros((2, rows, n))
    mass_in, bias_in = list(mass[0]), list(bias[0])

    looped = robot.mode == "effort" and sent is None
    setpoint = reference.copy() if sent is None else sent.copy()
    gravity = holding_effort(robot, reference) if looped else np.zeros_like(reference)
    position, velocity, effort = (np.empty((samples, rows, n)) for _ in range(3))
    acted = np.zeros((samples if outside is not None else 0, rows))
    touch = np.zeros((samples if robot.contact is not None else 0, rows))
    keep_every = round(RESTART / record)
    kept = np.zeros((-(-samples // keep_every), rows, n), STATE)
    crba, nle = pin.crba, pin.nonLinearEffects
    fresh = True
    for k in range(samples):
        if k % keep_every == 0:
            if restart is not None:
                state[:] = restart[k // keep_every]
                q[:], v[:] = state["q"], state["v"]
                fresh = True
            kept[k // keep_every] = state
        for i in each:
            crba(model, data[i], q_of[i])
            nle(model, data[i], q_of[i], v_of[i])
            mass_in[i][:] = mass_of[i]
            bias_in[i][:] = bias_of[i]
        advance(
            k, substeps, step, per_tick, DRIVES[robot.mode], looped, p, chain, contact, force,
            state, fresh, mass, bias, q, v, reference, gravity, setpoint, position, velocity,
            effort, acted, touch,
        )  # fmt: skip
        fresh = False
    raw = position
    position = raw * (1 + hidden.get("encoder_scale", "scale_error", n))
    position += hidden.get("encoder_bias", "bias", n)
    position += hidden.get("encoder_eccentricity", "sine", n) * np.sin(raw)
    position += hidden.get("encoder_eccentricity", "cosine", n) * (np.cos(raw) - 1)
    velocity *= 1 + hidden.get("encoder_scale", "scale_error", n)
    effort *= 1 + hidden.get("effort_scale", "scale_error", n)
    effort += hidden.get("effort_bias", "bias", n)
    return Motion(position, velocity, effort, setpoint, acted, touch, kept)
