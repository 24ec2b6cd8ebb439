"""Mass, centre and inertia of links that effects change, and of bodies with a point mass."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import ModelFields
from pytest_twin.metrics.pose import quaternion_of, rotation_of

if TYPE_CHECKING:
    from pytest_twin.effects.layout import Layout

_LEAST_MASS, _LEAST_MOMENT = 1e-6, 1e-9
"""Smallest mass in kg and moment of inertia in kg m^2, so that the simulator can divide by it."""


def with_point_mass(
    mass: FloatArray,
    center: FloatArray,
    moments: FloatArray,
    quat: FloatArray,
    added: FloatArray,
    at: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mass, centre of mass, principal moments and their orientation with added point masses.

    Args:
        mass: (n,) kg; center: (n, 3) m; moments: (n, 3) kg m^2 about it; quat: (n, 4) w first.
        added: (n,) kg; at: (n, 3) m, in the frames of the bodies.
    """
    total = np.maximum(mass + added, _LEAST_MASS)
    both = (mass[:, None] * center + added[:, None] * at) / total[:, None]
    turn = np.array([rotation_of(one) for one in quat])
    tensor = np.einsum("nij,nj,nkj->nik", turn, moments, turn)
    for weight, point in ((mass, center), (added, at)):
        arm = point - both
        square = np.einsum("ni,ni->n", arm, arm)
        steiner = square[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
        tensor += weight[:, None, None] * steiner
    values, axes = np.linalg.eigh(tensor)
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0
    quat = np.array([quaternion_of(one) for one in axes])
    return total, both, np.maximum(values, _LEAST_MOMENT), quat


def change_links(
    layout: Layout,
    fields: ModelFields,
    inertial: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    joint_position: FloatArray,
) -> None:
    """Change masses, centres of mass and inertias of links, and add point masses, in place.

    Args:
        inertial: (rows, bodies, ...) ``body_mass``, ``body_ipos``, ``body_inertia`` and
            ``body_iquat`` of MuJoCo.
        joint_position: (rows, joints of the model, 3) ``jnt_pos``, m.
    """
    mass, center, moments, quat = inertial
    bodies = layout.body_index
    mass[:, bodies] *= fields.mass_scale
    moments[:, bodies] *= fields.inertia_scale[:, :, None]
    if fields.center_moves.any():
        every = np.arange(len(bodies))
        center[:, bodies] += layout.center_shift(
            fields.center_radial, fields.center_tangential, every
        )
    row, joint = np.nonzero(fields.added_mass)
    if not len(row):
        return
    here = (row, bodies[joint])
    at = joint_position[row, layout.joint_ids[joint]]
    at = at + layout.to_link_frame(fields.added_at[row, joint], joint)
    mass[here], center[here], moments[here], quat[here] = with_point_mass(
        mass[here], center[here], moments[here], quat[here], fields.added_mass[row, joint], at
    )
