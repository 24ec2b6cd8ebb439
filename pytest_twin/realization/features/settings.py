"""Options of the simulator, and what belongs to no element."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pytest_twin.realization.features.canonical import (
    value_of,
)
from pytest_twin.realization.features.elements import Elements
from pytest_twin.realization.features.fields import CUSTOM, layer_of, model_fields

_LAYOUT_BYTES = 2**20


def options(elements: Elements) -> dict[str, Any]:
    """Every option by name, whatever options this MuJoCo has."""
    model = elements.model
    content = {
        name: value_of(getattr(model.opt, name))
        for name in dir(model.opt)
        if not name.startswith("_") and not callable(getattr(model.opt, name)) and name != "gravity"
    }
    content["timestep [s]"] = content.pop("timestep")
    content["contact limits"] = [int(model.nconmax), int(model.njmax)]
    # A small arena drops contacts; MuJoCo's own choice grows with what is only seen as well.
    if model.narena < _LAYOUT_BYTES:
        content["arena [bytes]"] = int(model.narena)
    # Solvers end by it. Where nobody states it, it follows from the masses.
    mean = float(model.dof_M0.mean()) if model.nv else 0.0
    stated = float(model.stat.meaninertia)
    if model.nv and not math.isclose(stated, mean, rel_tol=1e-6):
        content["mean inertia"] = stated
    return content


def custom(elements: Elements) -> dict[str, Any]:
    """What MuJoCo carries for others and does not feel itself."""
    model = elements.model
    content = {
        name: value_of(array)
        for name in sorted(CUSTOM)
        if isinstance(array := getattr(model, name), np.ndarray) and array.size
    }
    if model.text_data:
        content["text_data"] = value_of(model.text_data)
    return content


def other(elements: Elements) -> dict[str, Any]:
    """Fields that no layer claims, plugins among them."""
    model = elements.model
    content = {}
    for name in model_fields(model):
        if layer_of(name, model) == "other":
            value = getattr(model, name)
            # -1 is 'none' throughout: plugin ids of elements without a plugin.
            if not isinstance(value, np.ndarray) or np.any(value != -1):
                content[name] = value_of(value)
    return content
