"""Values that a simulator assumes because neither the robot's file nor the twin states them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pytest_twin.checks.proposals import Actuation
from pytest_twin.words import counted, list_names

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_MOST_NAMES = 4
"""Largest number of names in a line."""
_DENSITY = 1000.0
"""kg/m^3: MuJoCo's default density of a shape."""
_FRICTION = (1.0, 0.005, 0.0001)
"""MuJoCo's default friction of a shape: sliding (1), torsional and rolling (m)."""


def assumed_values(realization: Realization) -> tuple[str, ...]:
    """Return one line for each property that the simulator assumes, with the elements."""
    return (
        *_masses(realization),
        *_joints(realization),
        *_drives(realization),
        *_contact_friction(realization),
    )


def _masses(realization: Realization) -> Iterator[str]:
    from pytest_twin.realization.inertia import MASS_FLOOR

    model, bodies = realization.model, list(realization.spec.bodies)[1:]
    massless, by_density, raised = [], [], []
    least = realization.spec.compiler.boundmass
    for body in bodies:
        mass = float(model.body_mass[body.id])
        name = body.name or f"body {body.id}"
        if 0.0 < mass <= MASS_FLOOR:
            massless.append(name)
        elif least > 0.0 and mass == least:
            raised.append(name)
        elif mass > 0.0 and not body.explicitinertial:
            weighed = [geom for geom in body.geoms if np.isnan(geom.mass)]
            if any(geom.density == _DENSITY for geom in weighed):
                by_density.append(name)
    if massless:
        yield (
            f"no mass is stated for {_listed('link', massless)}: the simulator takes "
            f"{MASS_FLOOR:g} kg"
        )
    if raised:
        yield f"boundmass raises the mass of {_listed('link', raised)} to {least:g} kg"
    if by_density:
        yield (
            f"no mass is stated for {_listed('link', by_density)}: the simulator computes mass and "
            f"inertia from the shapes with {_DENSITY:g} kg/m^3"
        )
    if realization.spec.compiler.balanceinertia:
        yield "balanceinertia is on: the compiler changes impossible inertias"


def _joints(realization: Realization) -> Iterator[str]:
    model = realization.model
    loose, without_rotor = [], []
    for joint in realization.joints:
        if realization.structure.joint_type.get(joint) not in ("hinge", "slide"):
            continue
        dof = realization.joint_dof_index(joint)
        if model.dof_damping[dof].max() == 0.0 and model.dof_frictionloss[dof] == 0.0:
            loose.append(joint)
        if model.dof_armature[dof] == 0.0:
            without_rotor.append(joint)
    if loose:
        yield f"no friction and no damping is stated for {_listed('joint', loose)}: they have none"
    if without_rotor:
        yield f"no rotor inertia is stated for {_listed('joint', without_rotor)}: they have none"


def _drives(realization: Realization) -> Iterator[str]:
    commands = Actuation.of(realization).commands
    if not commands:
        yield "no drive is stated: nothing moves or holds a joint"
    elif commands == {"effort"}:
        yield "no gains are stated: the drives take torques or forces, and nothing holds a pose"


def _contact_friction(realization: Realization) -> Iterator[str]:
    model = realization.model
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    default = colliding & np.all(np.isclose(model.geom_friction, _FRICTION, rtol=1e-9), axis=1)
    if default.any():
        yield (
            f"{int(default.sum())} of {counted(int(colliding.sum()), 'collision shape')} have "
            f"MuJoCo's default contact friction, {_FRICTION[0]:g}"
        )


def _listed(noun: str, names: Sequence[str]) -> str:
    return f"{counted(len(names), noun)} ({list_names(names, _MOST_NAMES)})"
