"""Random Fourier series of joint positions, and efforts of a model and of its servos along them."""

from __future__ import annotations

import mujoco
import numpy as np
from scipy import signal

from pytest_twin.arrays import FloatArray


def fourier(
    random: np.random.Generator,
    time: FloatArray,
    joints: int,
    harmonics: int,
    base: float,
    sizes: tuple[float, float],
    decay: float = 0.5,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions, velocities and accelerations (n, joints), in rad, rad/s and rad/s^2.

    Args:
        random: generator of amplitudes and phases.
        time: (n,) s.
        joints: number of joints.
        harmonics: number of harmonics of each joint.
        base: frequency of the first harmonic, Hz.
        sizes: smallest and largest amplitude of the first harmonic, rad.
        decay: exponent with which amplitudes decrease with the number of the harmonic.
    """
    q, v, a = (np.zeros((len(time), joints)) for _ in range(3))
    for joint in range(joints):
        for harmonic in range(1, harmonics + 1):
            omega = 2 * np.pi * base * harmonic
            size, phase = random.uniform(*sizes) / harmonic**decay, random.uniform(0, 2 * np.pi)
            q[:, joint] += size * np.sin(omega * time + phase)
            v[:, joint] += size * omega * np.cos(omega * time + phase)
            a[:, joint] -= size * omega**2 * np.sin(omega * time + phase)
    return q, v, a


def needed_effort(
    model: mujoco.MjModel, q: FloatArray, v: FloatArray, a: FloatArray, *, dry: bool = True
) -> FloatArray:
    """(n, joints) effort of rigid bodies, armature, damping and dry friction along a motion.

    Args:
        model: model without constraints except dry friction, which is a constraint in MuJoCo.
        q, v, a: (n, joints) positions, velocities and accelerations.
        dry: whether dry friction is included.
    """
    data, disabled = mujoco.MjData(model), int(model.opt.disableflags)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    effort = np.empty_like(q)
    for at in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[at], v[at], a[at]
        mujoco.mj_inverse(model, data)
        effort[at] = data.qfrc_inverse
    model.opt.disableflags = disabled
    return effort + model.dof_frictionloss * np.sign(v) if dry else effort


def follow_noisy_positions(
    model: mujoco.MjModel,
    random: np.random.Generator,
    command: FloatArray,
    speed: FloatArray,
    gains: tuple[FloatArray, FloatArray],
    noise: float,
    tick: float = 0.005,
) -> tuple[FloatArray, FloatArray]:
    """(n, joints) measured positions, rad, and efforts, N*m, of servos that act on noisy positions.

    The encoder noise lies below 3 Hz, as the motion does, so that no filter removes it.

    Args:
        model: model without actuators; its time step is set to a fifth of ``tick``.
        random: generator of the noise.
        command, speed: (n, joints) commanded positions and velocities, rad and rad/s.
        gains: (joints,) stiffness, N*m/rad, and (joints,) damping, N*m*s/rad.
        noise: standard deviation of the encoder noise, rad.
        tick: period of servos and commands, s.
    """
    stiffness, damping = gains
    low = signal.butter(2, 3.0, fs=1.0 / tick, output="sos")
    added = signal.sosfilt(low, random.standard_normal(command.shape), axis=0)
    added *= noise / added.std(axis=0)
    data, inner = mujoco.MjData(model), 5
    model.opt.timestep = tick / inner
    data.qpos[:], data.qvel[:] = command[0], speed[0]
    seen, effort = np.empty_like(command), np.empty_like(command)
    for at in range(len(command)):
        seen[at] = data.qpos + added[at]
        velocity = (seen[at] - seen[at - 1]) / tick if at else speed[0]
        effort[at] = stiffness * (command[at] - seen[at]) + damping * (speed[at] - velocity)
        data.qfrc_applied[:] = effort[at]
        mujoco.mj_step(model, data, inner)
    return seen, effort
