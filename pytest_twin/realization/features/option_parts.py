"""Content of parts for simulation options, custom fields and unknown fields."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pytest_twin.realization.features.canonical import (
    value_of,
)
from pytest_twin.realization.features.elements import Elements
from pytest_twin.realization.features.fields import FIELDS_OF_LAYER, layer_of, model_fields

_LAYOUT_BYTES = 2**20
"""Size of an arena below which contacts may be dropped."""


def options(elements: Elements) -> dict[str, Any]:
    """All simulation options of the installed MuJoCo, by name."""
    model = elements.model
    content = {
        name: value_of(getattr(model.opt, name))
        for name in dir(model.opt)
        if not name.startswith("_") and not callable(getattr(model.opt, name)) and name != "gravity"
    }
    content["timestep [s]"] = content.pop("timestep")
    content["contact limits"] = [int(model.nconmax), int(model.njmax)]
    # A small arena drops contacts. A larger one is not stated, because MuJoCo's default also
    # depends on visual elements.
    if model.narena < _LAYOUT_BYTES:
        content["arena [bytes]"] = int(model.narena)
    # It scales the tolerance of the solver. By default it is computed from the masses.
    mean = float(model.dof_M0.mean()) if model.nv else 0.0
    stated = float(model.stat.meaninertia)
    if model.nv and not math.isclose(stated, mean, rel_tol=1e-6):
        content["mean inertia"] = stated
    return content


def custom(elements: Elements) -> dict[str, Any]:
    """Custom fields, which MuJoCo stores and does not use."""
    model = elements.model
    content = {
        name: value_of(array)
        for name in sorted(FIELDS_OF_LAYER["custom"])
        if isinstance(array := getattr(model, name), np.ndarray) and array.size
    }
    if model.text_data:
        content["text_data"] = value_of(model.text_data)
    return content


def other(elements: Elements) -> dict[str, Any]:
    """Fields that belong to no layer, for example those of plugins."""
    model = elements.model
    content = {}
    for name in model_fields(model):
        if layer_of(name, model) == "other":
            value = getattr(model, name)
            # An array of -1 means none, such as the plugin ids of elements without a plugin.
            if not isinstance(value, np.ndarray) or np.any(value != -1):
                content[name] = value_of(value)
    return content
