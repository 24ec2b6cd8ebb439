"""Detect drives with parameters that none can have: negative armature or friction."""

from __future__ import annotations

import numpy as np

from pytest_twin.identification.effort.essential_parameters import EssentialParameters
from pytest_twin.identification.effort.input_mistakes import InputMistake
from pytest_twin.identification.full_parameters import is_positive
from pytest_twin.identification.regressor import BaseParameters


def impossible_drives(base: BaseParameters, fitted: EssentialParameters) -> list[InputMistake]:
    """Return the drives' parameters that are negative beyond their 95 % intervals.

    Args:
        fitted: fit of the essential ones.
    """
    found = []
    solution = fitted.solution
    for i, value, half in zip(fitted.kept, solution.values, solution.half_width, strict=True):
        column = base.columns[base.independent[i]]
        alone = np.count_nonzero(base.combination[i]) == 1
        if alone and is_positive(column.kind) and value + half < 0.0:
            found.append(InputMistake(
                column.joint,
                f"{column.words} is negative: {value:.3g} ± {half:.2g} {column.unit}; the written "
                "model has 0",
                "look for what the model lacks (a spring, a cable, an elastic gear), or for a "
                "torque sensor on the link's side of the gear, which no armature and no friction "
                "reaches",
                is_fatal=False,
            ))  # fmt: skip
    return found
