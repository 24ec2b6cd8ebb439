"""Assign parameters of the inverse dynamics to stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from pytest_twin.effects import catalogue
from pytest_twin.identification.regressor import BaseParameters, Column, Regressor
from pytest_twin.identification.stages import StageName

_COUPLED = "coupled_"
"""Start of the names of parameters that a shared motor couples into another joint."""
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
    effect = catalogue().get(column.kind.removeprefix(_COUPLED))
    if effect is not None and effect.stage not in ("gravity", "inertia"):
        # Effects that are tried after all stages act on the joint like friction.
        return "friction" if effect.stage == "closed_loop" else cast(StageName, effect.stage)
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
            [_is_dry(column) and joint in (column.joint, column.partner) for column in columns]
            for joint in joints
        ]
    )


def _is_dry(column: Column) -> bool:
    effect = catalogue().get(column.kind.removeprefix(_COUPLED))
    return effect is not None and effect.dry_friction_level is not None
