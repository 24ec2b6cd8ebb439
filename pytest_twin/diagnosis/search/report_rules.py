"""Which effects of the last incumbent carry a name, by three rules.

1. A total of model and effects is possible, and shape parameters are in the recorded range.
2. The 95 % interval of an effect does not contain its absence.
3. An effect explains its own mismatch: of the error where it acts no large share remains.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.intervals import ParameterUncertainty
from pytest_twin.diagnosis.search.model import Model
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import Term

_NEEDED_SHARE = 0.25
"""Share of the mismatch from which an effect is needed, whatever its interval contains."""
_MAY_REMAIN = 0.25
"""Largest share of the squared mismatch that may remain where an effect acts."""


def rejections(
    model: Model,
    nominal: Model,
    without_each: Mapping[Term, FloatArray],
    uncertainty: ParameterUncertainty,
    floor: FloatArray,
    impossible: Mapping[Term, str],
    joints: int,
) -> dict[Term, str]:
    """Effects without a name -> the reason, for the reader.

    Args:
        model: the last incumbent, with its Jacobian.
        nominal: the model without effects.
        without_each: term -> (signals,) mean squared residual of the model refitted without it.
        floor: (signals,) noise floor.
        impossible: effects with impossible totals or outside the recorded range.
        joints: number of joints.
    """
    out = dict[Term, str]()
    before, after = (m.mean_square / floor**2 for m in (nominal, model))
    for term in model.hypothesis.terms:
        columns = _signals_of(term, joints, len(floor))
        if term in impossible:
            out[term] = impossible[term]
        elif contains_absence(model, term, uncertainty) and not _is_needed(
            without_each[term][columns] / floor[columns] ** 2, after[columns], before[columns]
        ):
            out[term] = "its 95 % interval contains its absence"
        elif (share := _remaining_share(before[columns], after[columns])) > _MAY_REMAIN:
            out[term] = (
                f"it is the closest known effect: {100 * share:.0f} % of the squared error remains "
                "where it acts"
            )
    return out


def contains_absence(model: Model, term: Term, uncertainty: ParameterUncertainty) -> bool:
    """Whether the 95 % region of the parameters that switch an effect on contains its absence.

    Parameters without a slope (the release of a drive) have no region; such an effect is present.
    """
    jacobian = model.jacobian
    assert jacobian is not None
    parameters = model.hypothesis.slice_of(term)
    amplitudes = term.amplitude_indices(model.hypothesis.theta[parameters])
    columns = np.array([parameters.start + k for k in amplitudes])
    if not np.any(jacobian[:, :, columns] != 0.0, axis=(0, 1)).all():
        return False
    neutral = np.array([term.parameters[k].neutral for k in amplitudes], dtype=float)
    offset = neutral - model.hypothesis.theta[columns]
    return uncertainty.normalized_distance(columns, offset) <= 1.0


def _is_needed(without: FloatArray, after: FloatArray, before: FloatArray) -> bool:
    """Whether the residual grows by a large share of the mismatch without an effect."""
    return bool((without - after > _NEEDED_SHARE * before).any())


def _remaining_share(before: FloatArray, after: FloatArray) -> float:
    """Share of the squared mismatch above the noise that remains; 0 where only noise remains."""
    if after.max() <= VERDICT.identifiable**2:
        return 0.0
    mismatch = float(np.maximum(before - 1.0, 0.0).sum())
    return float(np.maximum(after - 1.0, 0.0).sum()) / mismatch if mismatch > 0.0 else 0.0


def _signals_of(term: Term, joints: int, signals: int) -> slice:
    """Signals that an effect can change: positions and efforts of its joint, or of all joints.

    Of an error of effort readings these are efforts alone, since it changes no motion.
    """
    first = joints if term.law.needs_effort_sensor and signals > joints else 0
    return slice(first, None) if term.joint < 0 else slice(first + term.joint, None, joints)
