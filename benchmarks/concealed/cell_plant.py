"""Plant of the family ``sampled cells``: a robot in a :class:`cell.Cell`, simulated at 20 kHz."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from cell import BETWEEN, Background, Cell
from cell_friction import LAWS
from cell_kernel import BODY, JOINT, LINK, SERVO, STATE, rigid_terms, run, scratch
from kernel import DRIVES, OUTSIDE
from plant import Hidden
from robots import Robot
from setpoints import FINE

STEP = 5e-5
"""s, of the integrator."""
RECORD = 2.5e-4
"""s between samples that are kept."""
RESTART = 0.25
"""s between the states that a run keeps."""
GRAVITY = 9.81


@dataclass
class Run:
    """Simulated motion of a robot.

    Attributes:
        position, velocity, effort: (samples, recordings, joints) exact sensor readings.
        demand: (samples, recordings, joints) efforts that the servos demand, N*m.
        sent: (milliseconds, recordings, joints) commands sent to the servos.
        acted: (samples, recordings) force that is not in the catalogue.
        kept: (instants, recordings, joints) complete states, every :data:`RESTART` s.
        period: time between samples, s.
    """

    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    demand: np.ndarray
    sent: np.ndarray
    acted: np.ndarray
    kept: np.ndarray
    period: float = RECORD


def joint_rows(robot: Robot, hidden: Hidden, cell: Cell, step: float) -> np.ndarray:
    """(joints,) records of :data:`cell_kernel.JOINT`: the nominal robot with hidden effects."""
    n, j = len(robot.joints), robot.joints
    p = np.zeros(n, JOINT)

    def h(effect: str, name: str, neutral: float = 0.0) -> np.ndarray:
        return hidden.get(effect, name, n, neutral)

    p["kp"], p["kv"], p["peak"] = ([getattr(x, k) for x in j] for k in ("kp", "kv", "effort"))
    p["gain_p"] = p["kp"] * (1 + h("controller_gain", "stiffness_error"))
    p["gain_v"] = p["kv"] * (1 + h("controller_gain", "damping_error"))
    p["constant"] = 1 + h("torque_constant", "relative_error")
    p["limit"] = h("torque_saturation", "limit", np.inf)
    p["stall"] = h("torque_speed_limit", "stall", np.inf)
    p["free_speed"] = h("torque_speed_limit", "no_load_speed", np.inf)
    p["lag"] = h("actuator_lag", "time_constant")
    p["rate"] = h("rate_limit", "rate", np.inf)
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
    p["yield_at"], p["law"] = cell.yield_at, LAWS.index(cell.friction)
    p["pre_level"] = h("presliding_hysteresis", "coulomb")
    p["pre_x"] = h("presliding_hysteresis", "presliding_distance", 1.0)
    p["warm"] = h("thermal_friction", "excess")
    p["warm_time"] = h("thermal_friction", "warm_up_time", 1.0)
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
        elastic > 0, elastic * h("joint_elasticity", "damping_time"),
        0.6 * np.sqrt(p["tooth"] * p["armature"]),
    )  # fmt: skip
    p["delay"] = h("command_delay", "delay") + cell.transport
    p["loop_bias"] = h("encoder_bias", "bias") * h("encoder_bias", "in_loop")
    p["encoder"] = cell.encoder
    p["back_emf"] = p["peak"] / 20.0  # 20 rad/s at a voltage that makes the peak effort at rest
    return p


def servo_row(robot: Robot, cell: Cell, step: float) -> np.ndarray:
    """(1,) record of :data:`cell_kernel.SERVO`."""
    row = np.zeros(1, SERVO)
    tick = round(cell.command_period / FINE)
    moves_on = cell.between == "interpolated"
    row["mode"] = DRIVES[robot.mode]
    row["between"], row["tick"] = BETWEEN.index(cell.between), tick
    row["host"] = 1 if moves_on else tick
    if robot.mode == "effort":  # an effort command changes at the rate of the loop that computes it
        row["between"], row["tick"] = 0, row["host"]
    row["steps"] = max(round(cell.servo_period / step), 1)
    row["phase"] = int(cell.servo_phase / step)
    row["compute"] = round(cell.computing * cell.servo_period / step)
    period = float(row["steps"][0]) * step
    keep = np.exp(-2 * np.pi * cell.slope_cutoff * period)
    row["slope_keep"] = keep if cell.slope_cutoff > 0.0 else -1.0
    row["bandwidth"] = 2 * np.pi * cell.current_bandwidth
    row["electrical"] = cell.electrical
    return row


def body_rows(robot: Robot, hidden: Hidden, centers: np.ndarray | None = None) -> np.ndarray:
    """Records of :data:`cell_kernel.BODY`: the links, and a payload on the last."""
    rows = np.zeros(len(robot.joints), BODY)
    for i, j in enumerate(robot.joints):
        scale = 1.0
        scale += hidden.effects.get("inertial_parameters", {}).get(i, {}).get("relative_error", 0.0)
        rows[i] = (i, scale * j.mass, j.center, scale * np.diag(j.inertia))
    if centers is not None and len(centers):
        rows["center"] += centers
    mass = hidden.robot("payload", "mass")
    if not mass:
        return rows
    last = robot.joints[-1]
    toward = np.array(last.center) / np.linalg.norm(last.center)
    extra = np.zeros(1, BODY)
    at = hidden.robot("payload", "distance") * toward
    extra[0] = (len(robot.joints) - 1, mass, at, np.zeros((3, 3)))
    return np.concatenate([rows, extra])


def link_rows(robot: Robot, origins: np.ndarray | None = None) -> np.ndarray:
    """Records of :data:`cell_kernel.LINK`."""
    rows = np.zeros(len(robot.joints), LINK)
    for i, j in enumerate(robot.joints):
        rows[i] = (int(j.slide), j.origin, j.axis)
    if origins is not None and len(origins):
        rows["origin"] += origins
    return rows


def gravity_of(hidden: Hidden) -> np.ndarray:
    """(3,) m/s^2 in the frame of a base that may be tilted (roll about x, then pitch about y)."""
    roll, pitch = hidden.robot("base_tilt", "roll"), hidden.robot("base_tilt", "pitch")
    about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)],
                        [0, np.sin(roll), np.cos(roll)]])  # fmt: skip
    about_y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0],
                        [-np.sin(pitch), 0, np.cos(pitch)]])  # fmt: skip
    tilted: np.ndarray = (about_y @ about_x).T @ np.array([0.0, 0.0, -GRAVITY])
    return tilted


def holding_effort(robot: Robot, reference: np.ndarray) -> np.ndarray:
    """Gravity's effort on the nominal robot at (rows, joints) references."""
    n = len(robot.joints)
    mass, bias, still, work = np.empty((n, n)), np.empty(n), np.zeros(n), scratch(n)
    links, bodies = link_rows(robot), body_rows(robot, Hidden())
    gravity = np.array([0.0, 0.0, -GRAVITY])
    out = np.empty_like(reference)
    for row, q in zip(out, reference, strict=True):
        rigid_terms(links, bodies, gravity, q, still, mass, bias, work)
        row[:] = bias
    return out


def joined(hidden: Hidden, background: Background) -> Hidden:
    """Combine hidden effects and background; at most one of a name at a joint."""
    effects: dict[str, dict[int, dict[str, Any]]] = {
        e: {i: dict(p) for i, p in at.items()} for e, at in background.effects.items()
    }
    for effect, at in hidden.effects.items():
        effects.setdefault(effect, {}).update(at)
    return Hidden(effects)


def simulate(
    robot: Robot,
    cell: Cell,
    hidden: Hidden,
    background: Background,
    reference: np.ndarray,
    *,
    outside: np.ndarray | None = None,
    again: Run | None = None,
    step: float = STEP,
) -> Run:
    """Simulate a robot under setpoints (milliseconds, recordings, joints).

    An effort drive gets the effort of an outer PD loop with gravity compensation, which is then
    what is logged as the command.

    Args:
        outside: (1,) record of :data:`kernel.OUTSIDE`, a force that is not in the catalogue.
        again: another run, with whose commands and from whose states this one is restarted every
            :data:`RESTART` s.
    """
    real = joined(hidden, background)
    fine, rows, n = reference.shape
    p, servo = joint_rows(robot, real, cell, step), servo_row(robot, cell, step)
    links, bodies = link_rows(robot, background.origins), body_rows(robot, real, background.centers)
    gravity = gravity_of(real)
    force = np.zeros(1, OUTSIDE) if outside is None else outside
    every = round(RECORD / step)
    samples = round(fine * FINE / RECORD)
    position, velocity, effort, demand = (np.zeros((samples, rows, n)) for _ in range(4))
    acted = np.zeros((samples, rows))
    restart_every = round(RESTART / step)
    kept = np.zeros((-(-samples * every // restart_every), rows, n), STATE)
    looped = robot.mode == "effort" and again is None
    sent = np.zeros_like(reference) if looped else reference.copy()
    if again is not None:
        sent = again.sent.copy()
    for r in range(rows):
        ref = np.ascontiguousarray(reference[:, r])
        holding = holding_effort(robot, ref) if looped else np.zeros_like(ref)
        state = np.zeros(n, STATE)
        state["q"] = 0.0 if robot.mode == "velocity" else ref[0] - p["loop_bias"]
        state["theta"] = state["q"]
        state["read"] = state["q"] + p["loop_bias"]
        state["held"] = ref[0]
        restart = np.zeros((0, n), STATE) if again is None else again.kept[:, r].copy()
        traces = [np.zeros((samples, n)) for _ in range(4)]
        own, one, memory = np.ascontiguousarray(sent[:, r]), np.zeros(samples), kept[:, r].copy()
        run(samples * every, every, step, FINE, servo, p, links, bodies, gravity, force, state, ref,
            holding, own, looped, restart, restart_every, *traces, one, memory)  # fmt: skip
        position[:, r], velocity[:, r], effort[:, r], demand[:, r] = traces
        sent[:, r], acted[:, r], kept[:, r] = own, one, memory
    raw = position
    position = raw * (1 + real.get("encoder_scale", "scale_error", n))
    position += real.get("encoder_bias", "bias", n)
    position += real.get("encoder_eccentricity", "sine", n) * np.sin(raw)
    position += real.get("encoder_eccentricity", "cosine", n) * (np.cos(raw) - 1)
    velocity *= 1 + real.get("encoder_scale", "scale_error", n)
    effort = effort * (1 + real.get("effort_scale", "scale_error", n))
    effort += real.get("effort_bias", "bias", n)
    return Run(position, velocity, effort, demand, sent, acted, kept)
