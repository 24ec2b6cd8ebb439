"""Work of the engine that changes no number of a motion, and is left out of each step."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

_DISABLE = mujoco.mjtDisableBit
# The engine asks ``mjcb_time`` at the beginning and the end of each stage of a step, and the
# system's clock where nobody set one. This answers from a register, whatever is in it, by the
# conventions of calls on x86-64 and ARM; a function of Python would need the interpreter's lock.
_NO_CLOCK = (
    ctypes.CFUNCTYPE(ctypes.c_double)(("fabs", ctypes.CDLL(None))) if os.name == "posix" else None
)


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


@contextmanager
def unclocked() -> Iterator[None]:
    """Let the engine's profiler (``MjData.timer``) read no clock.

    That is an eighth to a quarter of a step's time. What the profiler says of the steps in here is
    void. A clock that somebody set is left in its place.
    """
    if _NO_CLOCK is None or mujoco.get_mjcb_time() is not None:
        yield
        return
    mujoco.set_mjcb_time(_NO_CLOCK)
    try:
        yield
    finally:
        mujoco.set_mjcb_time(None)
