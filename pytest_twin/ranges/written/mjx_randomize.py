"""``domain_randomize(model, rng)`` for MuJoCo MJX and mujoco_playground, from ``ranges.json``.

    from mjx_randomize import domain_randomize

    train(..., randomization_fn=domain_randomize)

It works for the checked model, whose body and joint ids are in ``ranges.json``. The robots
are drawn by ``sampler.py`` on the host, one for each key. Delays, encoder zeros and noise belong to
the environment: ``robots_of(rng)`` gives the same robots.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jp
import numpy as np
from sampler import Ranges

RANGES = Ranges.load(Path(__file__).with_name("ranges.json"))


def robots_of(rng: jax.Array) -> dict[str, np.ndarray]:
    """Return name -> (n, ...) values of the robots for (n,) or (n, 2) keys."""
    data = rng if jp.issubdtype(rng.dtype, jp.unsignedinteger) else jax.random.key_data(rng)
    keys = np.asarray(data).reshape(len(rng), -1)
    return RANGES.draw(len(keys), seed=[int(word) for word in keys.sum(axis=0) % 2**32])


def domain_randomize(model, rng):
    """Return the model with a leading axis in varied fields, and the axes for ``vmap``.

    Args:
        model: ``mjx.Model`` of the robot that was checked.
        rng: (n, 2) keys, one for each environment.
    """
    fields = RANGES.mujoco_fields(robots_of(rng))
    count = len(rng)
    changed = {}
    for name, places in fields.items():
        before = np.asarray(getattr(model, name))
        values = np.repeat(before[None], count, axis=0)
        for index, drawn in places.items():
            values[:, index] = drawn
        changed[name] = jp.asarray(values)
    axes = jax.tree_util.tree_map(lambda leaf: None, model)
    axes = axes.tree_replace(dict.fromkeys(changed, 0))
    return model.tree_replace(changed), axes
