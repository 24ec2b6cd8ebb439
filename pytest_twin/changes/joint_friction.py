"""Dry friction of one joint that changes together with its viscous or load-dependent friction.

Wear, grease and heat change them together. One law at a time, their sum is taken for a law between
them, such as a friction that rises with speed. So two together are a hypothesis of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pytest_twin.effects.friction import (
    CoulombFriction,
    LoadDependentFriction,
    ViscousFriction,
)
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape

_DRY = CoulombFriction.id
_WITH_DRY = (ViscousFriction.id, LoadDependentFriction.id)


@dataclass(frozen=True)
class JointFriction:
    """Two frictions of one joint.

    Attributes:
        term: key among the laws; no law of the catalogue has this name.
        members: index of the shape of each.
        columns: (2,) their columns.
    """

    term: Term
    members: tuple[int, int]
    columns: NDArray[np.intp]


def joint_frictions(shapes: Sequence[Shape]) -> list[JointFriction]:
    """Dry friction with another one, at every joint that has both, in every shape."""
    dry = {shape.term.joint: k for k, shape in enumerate(shapes) if shape.term.effect == _DRY}
    pairs = []
    for k, shape in enumerate(shapes):
        own = dry.get(shape.term.joint)
        if shape.term.effect in _WITH_DRY and own is not None:
            term = Term(f"{_DRY} and {shape.term.effect}", shape.term.joint)
            columns = np.concatenate([shapes[own].indices, shape.indices])
            pairs.append(JointFriction(term, (own, k), columns))
    return pairs
