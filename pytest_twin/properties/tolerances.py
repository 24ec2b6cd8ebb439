"""Allowed differences between realizations of one robot."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Tolerances of the properties.

    Attributes:
        position: position of a frame or of the centre of mass, m.
        orientation: orientation of a frame or of a joint axis, rad.
        mass: fraction of the mass.
        inertia: inertia of a link, fraction of its largest moment.
        gravity_torque: fraction of the upper bound g * sqrt(M_jj m) of a joint's gravity torque,
            with the mass m that the joint moves.
        mass_matrix: element M_ij, fraction of sqrt(M_ii M_jj).
        limit: ranges, velocities, efforts, damping, friction and couplings: fraction of the larger
            value, or absolute in its unit where it is below 1. Limits above 1e10 mean none.
        shape: bounding box of a collision shape along each axis, m.
        differences: comparisons with finite differences, fraction of the same scales.
        energy: change of energy of a system without damping and actuation, fraction of the
            kinetic energy.
        single: factor on all tolerances for a realization in single precision (USD).
    """

    position: float = 1e-6
    orientation: float = 1e-6
    mass: float = 1e-6
    inertia: float = 1e-6
    gravity_torque: float = 1e-6
    mass_matrix: float = 1e-6
    limit: float = 1e-6
    shape: float = 1e-5
    differences: float = 1e-5
    energy: float = 1e-5
    single: float = 10.0
