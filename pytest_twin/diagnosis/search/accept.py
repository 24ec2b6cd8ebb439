"""The acceptance test between two models, the only one of a search."""

from __future__ import annotations

import numpy as np

from pytest_twin.diagnosis.search.model import Acceptance, Model
from pytest_twin.diagnosis.search.settings import SETTINGS, SearchSettings
from pytest_twin.estimation.comparison import Comparison


def accepts(
    new: Model,
    old: Model,
    nominal: Model,
    comparison: Comparison,
    settings: SearchSettings = SETTINGS,
) -> Acceptance:
    """Whether ``new`` replaces ``old``.

    The score of the accepted models always increases. A richer model must also gain a least
    evidence, a least share of what all effects explain, and more than one standard error of the
    paired difference in predicting recordings that it was not fitted to.

    Args:
        new, old: the models, on the same samples.
        nominal: the model without effects.
    """
    if not new.is_finite:
        return Acceptance(False, "its simulation diverges")
    if not old.is_finite:
        return Acceptance(True, "the present model diverges")
    gain = new.score - old.score
    if not new.size.is_richer_than(old.size):
        # Two models of one size need a difference that is no rounding error.
        least = 1.0 if new.size == old.size else 0.0
        if gain <= least:
            return Acceptance(False, f"it scores {gain:+.1f} against the best")
        return Acceptance(True, f"it is no richer and scores {gain:+.1f} against the best")
    if gain < settings.earns:
        return Acceptance(
            False, f"it gains {gain:.1f}; a richer model needs at least {settings.earns:g}"
        )
    if new.size.effects > old.size.effects and not _is_worthwhile(
        new, old, nominal, comparison, settings
    ):
        return Acceptance(False, "its gain is too small a part of what all effects explain")
    mean, error = comparison.gain(new.predicted, old.predicted)
    if mean <= settings.standard_errors * error:
        return Acceptance(
            False,
            f"it predicts recordings that it was not fitted to better by {mean:.3g} only, with a "
            f"standard error of {error:.3g}",
        )
    return Acceptance(True, f"it gains {gain:.1f} and predicts held-out recordings better")


def _is_worthwhile(
    new: Model, old: Model, nominal: Model, comparison: Comparison, settings: SearchSettings
) -> bool:
    """Whether more effects gain enough of what all effects explain, in all signals or in one."""
    floor = comparison.floor**2
    with np.errstate(over="ignore", invalid="ignore"):
        each = [np.mean(m.predicted**2, axis=0) for m in (new, old, nominal)]
    levels = [np.log(np.maximum(np.nan_to_num(x, nan=np.inf), floor)) for x in each]
    best, before, whole = (0.5 * comparison.independent * level for level in levels)
    added, explained = before - best, np.where(np.isfinite(whole), whole - best, 0.0)
    worth = np.maximum(settings.share * explained, settings.earns)
    return bool((added >= worth).any() or added.sum() >= settings.share * explained.sum())
