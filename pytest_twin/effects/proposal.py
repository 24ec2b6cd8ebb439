"""Starts that an effect proposes to the search of a diagnosis."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray

if TYPE_CHECKING:
    from pytest_twin.effects.base import Effect


@dataclass(frozen=True, slots=True)
class JointFit:
    """The present fit at one joint whose residual is above the noise floor.

    Attributes:
        servo: command mode of the joint's drive; ``none`` without a drive.
        servo_compliance: reciprocal of the servo's stiffness, in multiples of the reference
            ``compliance``; 0 without a servo.
        present: parameters of the effect in the fit, in multiples of references; None if the fit
            does not contain it.
        longest_rest: longest time for which the joint's command is constant, s.
    """

    servo: str
    servo_compliance: float
    present: Mapping[str, float] | None
    longest_rest: float


@dataclass(frozen=True, slots=True)
class Start:
    """Parameters of an effect from which a fit may start.

    Attributes:
        parameters: (parameters,) of the effect, in multiples of references.
        others: effects of the same joint that start with it: effect id -> parameters by name, in
            multiples of references; a parameter that is absent here is zero.
    """

    parameters: FloatArray
    others: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def amplitude_indices(effect: Effect, parameters: FloatArray) -> tuple[int, ...]:
    """Indices of the amplitudes of an effect, in the form that ``parameters`` select.

    An amplitude is a parameter with a neutral value; the effect is absent where all amplitudes are
    neutral. The other parameters give the effect its shape.
    """
    has = effect.has(parameters)
    return tuple(i for i, p in enumerate(effect.parameters) if p.neutral is not None and has[i])


def is_estimated(effect: Effect, parameters: FloatArray) -> NDArray[np.bool_]:
    """(parameters,) whether a fit estimates each of them.

    Discrete choices are not estimated, nor parameters that the chosen form lacks.
    """
    choices = np.array([p.choice for p in effect.parameters])
    return np.asarray(effect.has(parameters) & ~choices)


def starting_sizes(effect: Effect) -> list[FloatArray]:
    """All combinations of the starts of an effect's parameters, those of its first form first.

    If the effect has several amplitudes, each of these has its first start only.
    """
    if not effect.has_forms:
        return _combinations(effect, [p.starts for p in effect.parameters])
    out = []
    for form in itertools.product(*(p.starts if p.choice else (0.0,) for p in effect.parameters)):
        has = effect.has(np.array(form))
        # Forms with their own shape parameters are many: shape parameters that all forms share
        # have their middle size only.
        has_own_shapes = any(
            p.under and p.neutral is None and here
            for p, here in zip(effect.parameters, has, strict=True)
        )
        starts: list[tuple[float, ...]] = []
        for p, chosen, here in zip(effect.parameters, form, has, strict=True):
            if p.choice or not here:
                starts.append((chosen,))
            elif has_own_shapes and p.neutral is None and p.under is None:
                starts.append((p.starts[len(p.starts) // 2],))
            else:
                starts.append(p.starts)
        out += _combinations(effect, starts)
    return out


def _combinations(effect: Effect, starts: Sequence[tuple[float, ...]]) -> list[FloatArray]:
    on = amplitude_indices(effect, np.array([s[0] for s in starts]))
    each = [s[:1] if len(on) > 1 and k in on else s for k, s in enumerate(starts)]
    return [np.array(size) for size in itertools.product(*each)]


def sizes_up_to_bound(effect: Effect) -> list[FloatArray]:
    """Sizes of a limit between its last starting size and its bound, in a geometric progression.

    Only forms with one estimated parameter have them; other effects have none.
    """
    out = []
    for start in starting_sizes(effect) if effect.is_limit else ():
        (own,) = np.nonzero(is_estimated(effect, start))
        if len(own) != 1:
            continue
        p = effect.parameters[own[0]]
        if start[own[0]] != p.starts[-1] or len(p.starts) < 2:
            continue
        ratio = p.starts[-1] / p.starts[-2]
        for k in range(int(np.log(p.upper / p.starts[-1]) / np.log(ratio))):
            size = start.copy()
            size[own[0]] *= ratio ** (k + 1)
            out.append(size)
    return out
