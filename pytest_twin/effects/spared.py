"""Work of the engine that changes no number, and is left out of each step."""

from __future__ import annotations

import mujoco

_DISABLE = mujoco.mjtDisableBit


def spare(model: mujoco.MjModel) -> None:
    """Switch off what the engine would look for in vain at each step.

    Islands of constraints, where there is one kinematic tree and so at most one island; contacts,
    where no two geoms can meet.

    Args:
        model: changed; its motion is the same to the last bit.
    """
    if model.ntree <= 1:
        model.opt.disableflags |= int(_DISABLE.mjDSBL_ISLAND)
    apart = not (model.geom_contype.any() and model.geom_conaffinity.any())
    if apart and not model.npair and not model.nflex:
        model.opt.disableflags |= int(_DISABLE.mjDSBL_CONTACT)
