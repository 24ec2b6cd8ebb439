"""MuJoCo options that save time without changing the motion."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

_DISABLE = mujoco.mjtDisableBit
# MuJoCo calls ``mjcb_time``, or else the system clock, around each stage of a step. This C function
# returns whatever is in a register, by the calling conventions of x86-64 and ARM. A Python function
# would need the interpreter's lock.
_NO_CLOCK = (
    ctypes.CFUNCTYPE(ctypes.c_double)(("fabs", ctypes.CDLL(None))) if os.name == "posix" else None
)


def spare(model: mujoco.MjModel) -> None:
    """Disable constraint islands for a single kinematic tree, and contacts where no geoms collide.

    Args:
        model: changed in place; its motion is bitwise the same.
    """
    if model.ntree <= 1:
        model.opt.disableflags |= int(_DISABLE.mjDSBL_ISLAND)
    apart = not (model.geom_contype.any() and model.geom_conaffinity.any())
    if apart and not model.npair and not model.nflex:
        model.opt.disableflags |= int(_DISABLE.mjDSBL_CONTACT)


@contextmanager
def unclocked() -> Iterator[None]:
    """Keep MuJoCo's profiler (``MjData.timer``) from reading the clock, 1/8 to 1/4 of a step.

    Profiler values of these steps are meaningless. A clock that was set before stays.
    """
    if _NO_CLOCK is None or mujoco.get_mjcb_time() is not None:
        yield
        return
    mujoco.set_mjcb_time(_NO_CLOCK)
    try:
        yield
    finally:
        mujoco.set_mjcb_time(None)
