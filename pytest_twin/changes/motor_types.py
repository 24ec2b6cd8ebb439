"""A law that changed in all motors of one type: one prior, and a value for each joint.

Amplitudes of a law at the joints of a type are the type's value times 1 + d. The deviations d are
normal, and their spread has a half-normal prior (Gelman, Bayesian Analysis 1, 2006). So a law of
one joint is not smeared over its type: there the spread would have to be large.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pytest_twin.arrays import FloatArray
from pytest_twin.changes.evidence import sizes
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape

_SPREAD = 0.5
"""Scale of the spread between motors of one type, relative to the type's value. An assumption for
all laws; the catalogue states no spread."""
_SPREADS = _SPREAD * ndtri(0.5 + 0.5 * np.array([1.0, 3.0, 5.0]) / 6.0)
"""Middles of three equally probable parts of the half-normal law."""
_OF_LINKS = "rigid_body"
"""Family of laws that belong to the links of the robot. Of these, a parameter of the joint itself
(armature) belongs to the motor."""


@dataclass(frozen=True)
class TypeLaw:
    """A law in one shape at all joints of a motor type.

    Attributes:
        term: the law; the joint is ``-2 - k`` for the k-th type.
        motor: name of the type.
        members: index of the shape of each joint.
        columns: (amplitudes * joints,) its columns, joint by joint.
        unit: (amplitudes * joints,) amplitudes of equal SI values; their RMS over joints is 1.
    """

    term: Term
    motor: str
    members: tuple[int, ...]
    columns: NDArray[np.intp]
    unit: FloatArray

    def priors(self) -> FloatArray:
        """(m, k, k) equally probable covariances of the amplitudes: of every size and spread."""
        amplitudes = len(self.columns) // len(self.members)
        which = np.arange(len(self.columns)) % amplitudes
        shared = (which[:, None] == which).astype(float)
        unit = np.outer(self.unit, self.unit)
        return np.concatenate([
            sizes(unit * (shared + spread**2 * np.eye(len(which))) / (1.0 + spread**2))
            for spread in _SPREADS
        ])  # fmt: skip


def type_laws(
    shapes: Sequence[Shape], scale: FloatArray, motors: Mapping[str, Sequence[int]]
) -> list[TypeLaw]:
    """Laws of all motor types with at least two joints.

    Args:
        shapes: every law at every joint.
        scale: (columns,) SI value of an amplitude of 1.
        motors: type -> its joints.
    """
    at_joint: dict[Term, list[int]] = {}
    for k, shape in enumerate(shapes):
        at_joint.setdefault(shape.term, []).append(k)
    found = []
    for number, (motor, joints) in enumerate(motors.items()):
        effects = dict.fromkeys(
            term.effect for term in at_joint if term.joint in joints and not _is_of_links(term)
        )
        for effect in effects if len(joints) > 1 else ():
            each = [at_joint.get(Term(effect, joint), []) for joint in joints]
            for members in zip(*each, strict=False):
                if len({len(shapes[k].columns) for k in members}) > 1:
                    continue
                columns = np.concatenate([shapes[k].indices for k in members])
                unit = (1.0 / scale[columns]).reshape(len(members), -1)
                unit = unit / np.sqrt(np.mean(unit**2, axis=0))
                found.append(
                    TypeLaw(Term(effect, -2 - number), motor, members, columns, unit.ravel())
                )
    return found


def _is_of_links(term: Term) -> bool:
    return term.law.family == _OF_LINKS and not term.law.mjcf_field
