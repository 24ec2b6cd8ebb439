"""Assign parameters of the inverse dynamics to stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.identification.regressor import BaseParameters, Column, Regressor
from pytest_twin.identification.stages import StageName

FRICTION = frozenset(
    {"viscous_friction", "coulomb_friction", "coupled_viscous_friction", "coupled_coulomb_friction"}
)
DRIVE = frozenset({"effort_bias", "effort_scale"})
_POSES = 64
"""Number of random poses at which efforts at rest are computed."""

EXCLUDES: Mapping[StageName, str] = {
    "delay": "a delay looks like damping: friction and inertia were free while it was fitted",
    "encoder": "a turned zero looks like a moved centre of mass: all parameters were free while it "
    "was fitted",
    "gravity": "friction and inertia were free while the weights were fitted, so that neither "
    "takes up a weight",
    "inertia": "weights and friction were free while the inertias were fitted",
    "friction": "weights, inertias and the drive's constant effort were free",
    "drive": "weights, inertias and friction were free",
}


def stage_of(column: Column, weighs: bool) -> StageName:
    """Return the stage that fits a parameter.

    Args:
        column: column of the regressor.
        weighs: whether the parameter causes an effort at rest.
    """
    if column.kind in FRICTION:
        return "friction"
    if column.kind in DRIVE:
        return "drive"
    return "gravity" if weighs else "inertia"


def stages_of(regressor: Regressor, base: BaseParameters) -> list[StageName]:
    """(b,) stage of each base parameter; those with an effort at rest belong to gravity."""
    count = len(regressor.joints)
    poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (_POSES, count))
    still = np.zeros_like(poses)
    at_rest = base.matrix(regressor.matrix(poses, still, still))
    moved = np.abs(at_rest).max(axis=(0, 1), initial=0.0) > 1e-9
    return [
        stage_of(base.columns[i], bool(weighs))
        for i, weighs in zip(base.independent, moved, strict=True)
    ]


def dry_of(columns: Sequence[Column], joints: Sequence[str]) -> NDArray[np.bool_]:
    """(joints, p) True for columns of dry friction that acts on a joint."""
    return np.array(
        [
            [
                "coulomb" in column.kind and joint in (column.joint, column.partner)
                for column in columns
            ]
            for joint in joints
        ]
    )
