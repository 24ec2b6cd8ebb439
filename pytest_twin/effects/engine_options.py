"""MuJoCo options that save time without changing the motion."""

from __future__ import annotations

import mujoco

_DISABLE = mujoco.mjtDisableBit


def disable_unused_features(model: mujoco.MjModel) -> None:
    """Disable constraint islands for a single kinematic tree, and contacts where no geoms collide.

    Args:
        model: changed in place; its motion remains bitwise equal.
    """
    if model.ntree <= 1:
        model.opt.disableflags |= int(_DISABLE.mjDSBL_ISLAND)
    apart = not (model.geom_contype.any() and model.geom_conaffinity.any())
    if apart and not model.npair and not model.nflex:
        model.opt.disableflags |= int(_DISABLE.mjDSBL_CONTACT)
