"""Reality for blind cases: a plant that is not MuJoCo and shares no code with pytest_twin.

Pinocchio's rigid-body terms, a semi-implicit integrator at 10 kHz, motor side and link side apart
where the transmission gives, friction with a bristle state (LuGre, Canudas de Wit et al. 1995)
where the package fits static curves, a drive with its own current lag, sensors with noise, counts
and jitter.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
from robots import Robot, pinocchio_model

STEP = 1e-4


@dataclass
class Hidden:
    """What reality has and the nominal model lacks: effect -> joint index (or -1) -> parameters."""

    effects: dict[str, dict[int, dict[str, float]]] = field(default_factory=dict)

    def get(self, effect: str, name: str, count: int, neutral: float) -> np.ndarray:
        """(count,) values of a parameter over the joints."""
        out = np.full(count, neutral)
        for joint, values in self.effects.get(effect, {}).items():
            out[slice(None) if joint < 0 else joint] = values[name]
        return out

    def robot(self, effect: str, name: str, neutral: float) -> float:
        """A parameter of the whole robot."""
        return self.effects.get(effect, {}).get(-1, {}).get(name, neutral)


@dataclass
class Motion:
    """What the plant did at 10 kHz, (steps, recordings, joints) or one recording of it."""

    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    setpoint: np.ndarray

    def recording(self, i: int) -> Motion:
        """One recording's (steps, joints)."""
        return Motion(*(a[:, i] for a in vars(self).values()))


def simulate(
    robot: Robot, hidden: Hidden, reference: np.ndarray, start: np.ndarray, *, extra: Any = None
) -> Motion:
    """Run the plant under references (steps, recordings, joints) at 10 kHz.

    All recordings run side by side; ``start`` is (recordings, joints). A position or velocity servo
    follows them itself; an effort drive gets the effort of an outer PD loop with gravity
    compensation, which is then the recorded command.
    """
    n = len(robot.joints)
    j = robot.joints
    base = np.array([0.0, 0.0, -9.81])
    roll, pitch = hidden.robot("base_tilt", "roll", 0.0), hidden.robot("base_tilt", "pitch", 0.0)
    tilt = pin.rpy.rpyToMatrix(roll, pitch, 0.0)
    scale = {
        i: 1.0 + v["relative_error"]
        for i, v in hidden.effects.get("inertial_parameters", {}).items()
    }
    payload = (hidden.robot("payload", "mass", 0.0), hidden.robot("payload", "distance", 0.0))
    model = pinocchio_model(robot, scale, payload, tilt.T @ base)
    data = model.createData()
    nominal = pinocchio_model(robot, {}, (0.0, 0.0), base)
    nominal_data = nominal.createData()

    def h(effect: str, name: str, neutral: float = 0.0) -> np.ndarray:
        return hidden.get(effect, name, n, neutral)

    kp, kv = np.array([x.kp for x in j]), np.array([x.kv for x in j])
    peak = np.array([x.effort for x in j])
    gain_p = kp * (1 + h("controller_gain", "stiffness_error"))
    gain_v = kv * (1 + h("controller_gain", "damping_error"))
    constant = 1 + h("torque_constant", "relative_error")
    limit = h("torque_saturation", "limit", np.inf)
    stall, free_speed = (
        h("torque_speed_limit", "stall", np.inf),
        h("torque_speed_limit", "no_load_speed", np.inf),
    )
    lag = h("actuator_lag", "time_constant")
    lag_keep = np.exp(-STEP / np.maximum(lag, 1e-9))
    rate = h("rate_limit", "rate", np.inf) * STEP
    dead = h("dead_zone", "width")
    cog_s, cog_c = h("cogging", "sine"), h("cogging", "cosine")
    cog_n = h("cogging", "harmonic", 1.0)
    armature = np.array([x.armature for x in j]) + h("armature", "inertia")
    viscous = np.array([x.damping for x in j]) + h("viscous_friction", "coefficient")
    drag = h("quadratic_drag", "coefficient")
    coulomb = np.array([x.friction for x in j]) + h("coulomb_friction", "coulomb")
    coulomb = coulomb + h("asymmetric_friction", "coulomb") + h("stribeck_friction", "coulomb")
    offset = h("asymmetric_friction", "offset")
    stiction = h("stribeck_friction", "stiction_excess")
    v_stribeck = h("stribeck_friction", "stribeck_velocity", 1.0)
    load_mu = h("load_dependent_friction", "coefficient")
    pre_level = h("presliding_hysteresis", "coulomb")
    pre_x = h("presliding_hysteresis", "presliding_distance", 1.0)
    warm, warm_time = h("thermal_friction", "excess"), h("thermal_friction", "warm_up_time", 1.0)
    pos_m, pos_s = (
        h("position_dependent_friction", "mean"),
        h("position_dependent_friction", "sine"),
    )
    pos_c = h("position_dependent_friction", "cosine")
    spring, preload = h("joint_spring", "stiffness"), h("joint_spring", "preload")
    coupling = h("joint_coupling", "ratio")
    push, push_at = h("external_force", "effort"), h("external_force", "start")
    push_for = h("external_force", "duration", 1.0)
    gap = h("backlash", "gap")
    elastic = h("joint_elasticity", "stiffness", 0.0)
    elastic_damping = h("joint_elasticity", "damping", 0.0)
    delay = np.round(h("command_delay", "delay") / STEP).astype(int)
    bias = h("encoder_bias", "bias")
    soft = (gap > 0) | (elastic > 0)
    # A gap is bridged by teeth that are stiff against the servo.
    tooth = np.where(elastic > 0, elastic, 40.0 * np.maximum(gain_p, 1.0))
    tooth_damping = np.where(elastic > 0, elastic_damping, 2.0 * np.sqrt(tooth * armature) * 0.3)

    rows = len(start)
    q, v = start.copy(), np.zeros((rows, n))
    theta, omega = start.copy(), np.zeros((rows, n))
    bristle, pre_z = np.zeros((rows, n)), np.zeros((rows, n))
    nle, mass = np.empty((rows, n)), np.empty((rows, n, n))
    columns = np.arange(n)
    held, drive_state = reference[0].copy(), None
    stiff_bristle = 2e-4
    steps = len(reference)
    positions, velocities, efforts, sent = (np.empty((steps, rows, n)) for _ in range(4))
    every = round(0.01 / STEP)
    command = reference[0].copy()
    for k in range(steps):
        motor_q, motor_v = np.where(soft, theta, q), np.where(soft, omega, v)
        # The recorded encoder sits on the link; the servo closes its loop on the motor.
        positions[k], velocities[k] = q, v
        if robot.mode == "effort" and k % every == 0:
            gravity = np.array(
                [pin.computeGeneralizedGravity(nominal, nominal_data, r) for r in reference[k]]
            )
            ahead = reference[min(k + 1, steps - 1)] - reference[k]
            command = gravity + kp * (reference[k] - q) + kv * (ahead / STEP - v)
        elif robot.mode != "effort":
            command = reference[k]
        sent[k] = command
        u = sent[np.maximum(k - delay, 0), :, columns].T
        held = held + np.clip(u - held, -rate, rate) if robot.mode != "effort" else u
        u = held
        if robot.mode == "position":
            error = u - motor_q
            error = error - np.clip(error, -dead, dead)
            drive = gain_p * error - gain_v * motor_v
        elif robot.mode == "velocity":
            drive = gain_v * (u - np.clip(u, -dead, dead) - motor_v)
        else:
            drive = u - np.clip(u, -dead, dead)
        drive = np.clip(drive, -peak, peak) * constant
        drive = np.clip(drive, -limit, limit)
        top = stall * np.clip(1 - motor_v / free_speed, 0, 1)
        bottom = -stall * np.clip(1 + motor_v / free_speed, 0, 1)
        with np.errstate(invalid="ignore"):
            drive = np.where(np.isfinite(stall), np.clip(drive, bottom, top), drive)
        drive_state = drive if drive_state is None else drive + lag_keep * (drive_state - drive)
        drive = drive_state
        delivered = drive.copy()
        delivered[:, 1:] += coupling[1:] * drive[:, :-1]
        efforts[k] = delivered
        t = k * STEP
        extra_force = extra(t, q, v) if extra is not None else 0.0
        motor_side = (
            delivered
            - viscous * motor_v
            - drag * motor_v * np.abs(motor_v)
            - offset
            + cog_s * np.sin(cog_n * motor_q)
            + cog_c * np.cos(cog_n * motor_q)
        )
        pre_z += STEP * (motor_v - np.abs(motor_v) * pre_z / pre_x)
        motor_side -= pre_level * pre_z / pre_x
        for i in range(rows):
            nle[i] = pin.nonLinearEffects(model, data, q[i], v[i])
            upper = pin.crba(model, data, q[i])
            mass[i] = np.triu(upper) + np.triu(upper, 1).T
        level = (
            coulomb
            + stiction * np.exp(-((motor_v / v_stribeck) ** 2))
            + load_mu * np.abs(nle)
            + warm * np.exp(-t / warm_time)
            + pos_m
            + pos_s * np.sin(q)
            + pos_c * np.cos(q)
        )
        level = np.maximum(level, 1e-9)
        # LuGre: the bristle yields 0.2 mrad, then slides; damped so that it does not ring.
        rate_z = motor_v - np.abs(motor_v) * bristle / stiff_bristle
        bristle = np.clip(bristle + STEP * rate_z, -stiff_bristle, stiff_bristle)
        link_side = preload - spring * q - nle + extra_force
        link_side = link_side + push * ((t >= push_at) & (t < push_at + push_for))
        inertia = mass + np.diag(np.where(soft, 0.0, armature))
        twist = theta - q
        stretch = twist - np.clip(twist, -gap / 2, gap / 2)
        touching = (stretch != 0) | (gap == 0)
        through = tooth * stretch + tooth_damping * (omega - v) * touching
        friction = level * bristle / stiff_bristle
        bristle_damping = 0.7 * np.sqrt(level / stiff_bristle * armature)
        friction = friction + bristle_damping * rate_z
        rigid = link_side + np.where(soft, through, motor_side - friction)
        v = v + STEP * np.linalg.solve(inertia, rigid[:, :, None])[:, :, 0]
        q = q + STEP * v
        omega_next = omega + STEP * (motor_side - friction - through) / armature
        omega = np.where(soft, omega_next, v)
        theta = np.where(soft, theta + STEP * omega, q)
    positions = positions + bias
    factor = 1 + h("encoder_scale", "scale_error")
    ecc_s, ecc_c = h("encoder_eccentricity", "sine"), h("encoder_eccentricity", "cosine")
    raw = positions - bias
    positions = raw * factor + ecc_s * np.sin(raw) + ecc_c * (np.cos(raw) - 1) + bias
    velocities = velocities * factor
    efforts = efforts * (1 + h("effort_scale", "scale_error")) + h("effort_bias", "bias")
    return Motion(positions, velocities, efforts, sent)
