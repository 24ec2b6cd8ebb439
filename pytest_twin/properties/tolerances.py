"""How far apart two realizations of one robot may be."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Bounds of the properties.

    Attributes:
        position: of a frame, and of the centre of mass, m.
        orientation: of a frame, and of a joint's direction, rad.
        mass: share of the mass.
        inertia: of a link's inertia, share of its largest moment.
        gravity_torque: share of what the mass that a joint carries weighs at its radius of
            gyration, g * sqrt(M_jj m): the most that gravity could ask of the joint.
        mass_matrix: of M_ij, share of sqrt(M_ii M_jj).
        limit: of ranges, velocities, efforts, damping, friction and couplings; share of the larger
            value, or rad, m, and so on, where that is below 1. Bounds beyond 1e10 are none.
        shape: of the box that holds a collision shape, along each axis, m.
        differences: of what is compared with finite differences, share of the same scales.
        energy: growth or loss of a system that nothing damps or drives, share of the kinetic
            energy.
        single: factor on all of them for a form that holds its numbers in single precision (USD).
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
