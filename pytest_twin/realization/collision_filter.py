"""Pairs that MuJoCo keeps apart: by its built-in filters, exclude elements and contact masks."""

from __future__ import annotations

from typing import TypeAlias

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Bools: TypeAlias = NDArray[np.bool_]


def are_one_or_linked(model: mujoco.MjModel, first: ArrayLike, second: ArrayLike) -> Bools:
    """Whether two bodies are rigidly connected, or one is the parent of the other.

    A body and its parent collide where the parent is fixed to the world, or where the model turns
    off this filter.
    """
    weld, parent = model.body_weldid, model.body_parentid
    a, b = weld[np.asarray(first)], weld[np.asarray(second)]
    linked = ((a == weld[parent[b]]) | (b == weld[parent[a]])) & (a != 0) & (b != 0)
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        linked = np.zeros_like(linked)
    return np.asarray((a == b) | linked)


def are_excluded(model: mujoco.MjModel, first: ArrayLike, second: ArrayLike) -> Bools:
    """Whether an exclude element names the two bodies."""
    a, b = np.asarray(first, dtype=np.int64), np.asarray(second, dtype=np.int64)
    return np.isin((np.minimum(a, b) << 16) + np.maximum(a, b), model.exclude_signature)


def have_matching_masks(model: mujoco.MjModel, first: ArrayLike, second: ArrayLike) -> Bools:
    """Whether contype and conaffinity of two geoms have a bit in common."""
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    g, h = np.asarray(first), np.asarray(second)
    return np.asarray((contype[g] & conaffinity[h] | contype[h] & conaffinity[g]) != 0)
