"""Properties of the dynamics of each realization by itself.

They follow from the laws of rigid-body dynamics (Siciliano et al., "Robotics: Modelling, Planning
and Control", 2009, ch. 7; Featherstone, "Rigid Body Dynamics Algorithms", 2008, ch. 2 and 6).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from pytest_twin.metrics.pose import inverse
from pytest_twin.properties.agreement import Q, gravity_scales, matrix_of
from pytest_twin.properties.asset import Asset
from pytest_twin.properties.form import Form
from pytest_twin.properties.trees import joint_names
from pytest_twin.properties.violation import Broken

Vector = NDArray[np.float64]

_STEP = 1e-4  # rad or m, step of finite differences; their error is about its square
_NOISE = 1e-8  # N*m, N, J: rounding error of a difference of energies
_LIGHT = 1e-9  # kg, moved mass below which a joint counts as moving no body
_TRIANGLE = 1e-5  # fraction of the largest moment: rounded digits of a file
_DURATION = 0.05  # s
_TIMESTEP = 1e-3  # s
_MIN_INERTIA_SHARE = 1e-3  # smallest inertia of a joint in the simulation, fraction of the largest
_REFINED = 5  # number of halvings of the step before energy counts as not conserved


def positive_definite_mass_matrix(asset: Asset, q: Q) -> Iterator[Broken]:
    """The mass matrix is symmetric and positive definite."""
    for form in asset.forms:
        joints = tuple(
            joint for joint in form.dynamics.joints if asset.carried.get(joint, 1.0) > _LIGHT
        )
        matrix = matrix_of(form, q, joints)
        scale = np.sqrt(np.abs(np.diag(matrix)))
        for i in np.flatnonzero(~(scale > 0)):
            words = "moves a body without feeling inertia"
            yield Broken(f"joint '{joints[i]}'", words, math.inf, 0.0, "", form.name)
        if not joints or not np.all(scale > 0):
            continue
        unit = matrix / np.outer(scale, scale)
        skew = float(np.abs(unit - unit.T).max())
        bound = asset.factor(form) * asset.tolerances.mass_matrix
        if not skew <= bound:
            words = "is not symmetric, as a share of its diagonal"
            yield Broken("the mass matrix", words, skew, bound, "", form.name)
        values, vectors = np.linalg.eigh((unit + unit.T) / 2)
        # Rounding error of a sum of n terms of size 1.
        least = -1e-15 * len(joints)
        if not values[0] > least:
            joint = joints[int(np.argmax(np.abs(vectors[:, 0])))]
            words = "the mass matrix has a negative eigenvalue, mostly along this joint,"
            yield Broken(f"joint '{joint}'", words, -float(values[0]), -least, "", form.name)


def possible_inertias(asset: Asset) -> Iterator[Broken]:
    """The mass and inertia of every link are physically consistent (triangle inequality)."""
    from pytest_twin.realization.inertia import MASS_FLOOR, violation

    for form in asset.forms:
        for name, link in form.description.links.items():
            # An inertia that is zero apart from rounding errors of a frame transformation.
            none = float(np.abs(link.inertia).max()) < MASS_FLOOR
            share = 0.0 if none else violation(link.inertia)
            if link.mass < 0:
                words = "has a negative mass"
                yield Broken(f"link '{name}'", words, -link.mass, 0.0, "kg", form.name)
            if share > _TRIANGLE:
                words = "a principal moment exceeds the sum of the other two, as a share of it,"
                yield Broken(f"link '{name}'", words, share, _TRIANGLE, "", form.name)


def gravity_is_gradient(asset: Asset, q: Q) -> Iterator[Broken]:
    """The gravity torque is the gradient of the potential energy."""
    for form in asset.forms:
        dynamics = form.dynamics
        gravity, mass = np.array(form.gravity), dynamics.mass()
        torque, scales = dynamics.gravity_torque(q), gravity_scales(asset, form, q)
        noise = _NOISE * max(1.0, mass)
        for i, joint in enumerate(dynamics.joints):
            energies = [
                -mass * float(gravity @ dynamics.center_of_mass({**q, joint: value}))
                for value in (q.get(joint, 0.0) + _STEP, q.get(joint, 0.0) - _STEP)
            ]
            slope = (energies[0] - energies[1]) / (2 * _STEP)
            apart = abs(slope - float(torque[i]))
            bound = asset.factor(form) * asset.tolerances.differences * scales[joint] + noise
            if not apart <= bound:
                words = f"gravity torque {torque[i]:.6g} is not dV/dq {slope:.6g}, off"
                yield Broken(f"joint '{joint}'", words, apart, bound, "N*m or N", form.name)


def kinetic_energy(asset: Asset, q: Q) -> Iterator[Broken]:
    """Half q' M q' equals the kinetic energy of the links, computed from their poses."""
    for form in asset.forms:
        if not form.description.links:
            continue
        dynamics = form.dynamics
        speed = {joint: asset.velocity.get(joint, 1.0) for joint in dynamics.joints}
        ahead, behind = (
            dynamics.poses({j: q.get(j, 0.0) + sign * _STEP * v for j, v in speed.items()})
            for sign in (1.0, -1.0)
        )
        moved = 0.0
        for name, link in form.description.links.items():
            if name not in ahead or not (link.mass > 0 or np.any(link.inertia)):
                continue
            one, two = behind[name], ahead[name]
            arm = np.append(link.com, 1.0)
            velocity = ((two @ arm) - (one @ arm))[:3] / (2 * _STEP)
            # The rotation between the two orientations, in the frame of the link.
            turn = (inverse(one) @ two)[:3, :3]
            spin = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) - np.array(
                [turn[1, 2], turn[2, 0], turn[0, 1]]
            )
            spin = spin / (4 * _STEP)
            moved += 0.5 * link.mass * float(velocity @ velocity)
            moved += 0.5 * float(spin @ link.inertia @ spin)
        rates = np.array([speed[joint] for joint in dynamics.joints])
        stated = 0.5 * float(rates @ matrix_of(form, q) @ rates)
        bound = asset.factor(form) * asset.tolerances.differences * max(moved, stated) + _NOISE
        if not abs(moved - stated) <= bound:
            words = f"has {stated:.6g} J by its mass matrix and {moved:.6g} J by its links, off"
            yield Broken("the robot", words, abs(moved - stated), bound, "J", form.name)


def coriolis_forces(asset: Asset, q: Q) -> Iterator[Broken]:
    """Coriolis and centrifugal forces follow from the mass matrix: M' q' - grad(q' M q') / 2.

    With the matrix C of these Christoffel terms, M' - 2C is skew-symmetric, so that they do no
    work.
    """
    import mujoco

    for form in asset.simulated:
        model, dynamics = form.model, form.dynamics
        names = dynamics.joints
        if not names:
            continue
        rates = np.array([asset.velocity.get(joint, 1.0) for joint in names])
        joint_ids = [joint_names(model).index(name) for name in names]
        index = model.jnt_dofadr[joint_ids].tolist()
        data = mujoco.MjData(model)
        for name, joint_id in zip(names, joint_ids, strict=True):
            if name in q:
                data.qpos[int(model.jnt_qposadr[joint_id])] = q[name]
        mujoco.mj_fwdPosition(model, data)
        forces = []
        for scale in (1.0, 0.0):
            data.qvel[:] = 0.0
            data.qvel[index] = scale * rates
            mujoco.mj_fwdVelocity(model, data)
            forces.append(data.qfrc_bias[index].copy())
        measured = forces[0] - forces[1]

        def at(moves: Mapping[str, float], form: Form = form) -> Vector:
            return matrix_of(form, {**q, **{j: q.get(j, 0.0) + d for j, d in moves.items()}})

        along = dict(zip(names, rates, strict=True))
        change = at({j: _STEP * v for j, v in along.items()}) - at(
            {j: -_STEP * v for j, v in along.items()}
        )
        expected = change @ rates / (2 * _STEP)
        for i, name in enumerate(names):
            slope = at({name: _STEP}) - at({name: -_STEP})
            expected[i] -= 0.5 * float(rates @ slope @ rates) / (2 * _STEP)
        matrix = matrix_of(form, q)
        energy = float(rates @ np.diag(np.diag(matrix)) @ rates)
        for i, name in enumerate(names):
            scale_i = math.sqrt(max(0.0, float(matrix[i, i])) * energy)
            bound = asset.tolerances.differences * scale_i + _NOISE * max(1.0, energy)
            apart = abs(float(measured[i] - expected[i]))
            if not apart <= bound:
                words = "Coriolis and centrifugal force is not that of the mass matrix, off"
                yield Broken(f"joint '{name}'", words, apart, bound, "N*m or N", form.name)


def energy_conservation(asset: Asset, q: Q) -> Iterator[Broken]:
    """Without damping, actuation and contact, the energy of the robot is constant.

    The robot is simulated with RK4, with springs and gravity only. The step is halved until the
    energy is constant, which it must be for a sufficiently small step.
    """
    from pytest_twin.realization.mujoco_warnings import suppress_mujoco_warnings

    for form in asset.simulated:
        drift = bound = math.inf
        for halvings in range(_REFINED + 1):
            with suppress_mujoco_warnings():
                drift, kinetic = _drift(asset, form, q, _TIMESTEP / 2**halvings)
            bound = asset.tolerances.energy * kinetic + _NOISE
            if drift <= bound:
                break
        else:
            words = f"its energy changes within {_DURATION:g} s"
            yield Broken("the undamped robot", words, drift, bound, "J", form.name)


def _drift(asset: Asset, form: Form, q: Q, timestep: float) -> tuple[float, float]:
    """Largest change of the energy, and largest kinetic energy, J."""
    import mujoco

    model = copy.copy(form.model)
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= int(off.mjDSBL_CONSTRAINT | off.mjDSBL_ACTUATION | off.mjDSBL_DAMPER)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = timestep
    model.opt.density = model.opt.viscosity = 0.0
    model.body_gravcomp[:] = 0.0
    data = mujoco.MjData(model)
    # Armature also conserves energy; with it, joints with tiny inertia need no tiny steps.
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    diagonal = np.diag(inertia)
    model.dof_armature[:] += np.maximum(
        _MIN_INERTIA_SHARE * diagonal.max(initial=0.0) - diagonal, 0.0
    )
    for name in form.dynamics.joints:
        joint_id = joint_names(model).index(name)
        address = int(model.jnt_qposadr[joint_id])
        data.qpos[address] = q.get(name, float(model.qpos0[address]))
        data.qvel[int(model.jnt_dofadr[joint_id])] = asset.velocity.get(name, 0.0)
    mujoco.mj_forward(model, data)
    start, drift, kinetic = float(data.energy.sum()), 0.0, float(data.energy[1])
    for _ in range(round(_DURATION / timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        if not math.isfinite(float(data.energy.sum())):
            return math.inf, kinetic
        drift = max(drift, abs(float(data.energy.sum()) - start))
        kinetic = max(kinetic, float(data.energy[1]))
    return drift, kinetic
