"""Selection of the effects that act on rows, and combination of effects with fixed ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pytest_twin.effects import catalogue
from pytest_twin.effects.base import Effect, Values

EffectValues = Mapping[str, Values]
"""Effect id -> parameter name -> (rows, joints) values."""

ActiveEffects = Sequence[tuple[Effect, Values]]
"""Effects with their parameters for rows."""

STEP_HOOKS = ("command", "servo", "drive", "friction", "force", "gear")


def add_fixed_effects(values: EffectValues, fixed: EffectValues, rows: int) -> EffectValues:
    """Effects of rows combined with fixed effects: amplitudes add, fixed shape parameters stay.

    Relative errors multiply, so that a gain is changed by a factor of what it is.
    """
    if not fixed:
        return values
    out = {e: dict(v) for e, v in values.items()}
    for effect, own in fixed.items():
        if effect not in out:
            out[effect] = {n: np.repeat(v, rows, axis=0) for n, v in own.items()}
            continue
        parameters = catalogue()[effect].parameters
        acts = acts_at(catalogue()[effect], own)
        for p in parameters:
            theirs = out[effect][p.name]
            if p.neutral is not None:
                out[effect][p.name] = p.combined(theirs, own[p.name])
            else:
                out[effect][p.name] = np.where(acts, own[p.name], theirs)
    return out


def hooks_between_steps(
    effects: Sequence[tuple[Effect, Values]],
) -> dict[str, list[tuple[Effect, Values]]]:
    """Hook -> effects that override it, in their order."""
    return {h: [(e, v) for e, v in effects if e.overrides(h)] for h in STEP_HOOKS}


def acts_between_steps(values: EffectValues, count: int) -> NDArray[np.bool_]:
    """(rows, effects) whether an effect with a hook between steps acts on a row."""
    laws = [(catalogue()[name], v) for name, v in values.items()]
    found = [acts_at(e, v).any(axis=1) for e, v in laws if e.overrides(*STEP_HOOKS)]
    return np.array(found, dtype=bool).reshape(-1, count).T


def overrides_any(effects: Sequence[tuple[Effect, Values]], *hooks: str) -> bool:
    """Whether any effect overrides one of these hooks."""
    return any(effect.overrides(*hooks) for effect, _ in effects)


def active_effects(values: EffectValues) -> list[tuple[Effect, Values]]:
    """Effects that act on at least one row, in the order in which they act on a reading."""
    return [(effect, v) for effect, v in sort_by_hook_order(values) if acts_at(effect, v).any()]


def sort_by_hook_order(values: EffectValues) -> list[tuple[Effect, Values]]:
    """Effects in the order in which they act on a reading."""
    effects = [(catalogue()[e], v) for e, v in values.items()]
    return sorted(effects, key=lambda each: each[0].hook_order)


def acts_at(effect: Effect, values: Values) -> NDArray[np.bool_]:
    """(rows, joints) where an effect acts: a parameter with a neutral value differs from it."""
    switches = [p for p in effect.parameters if p.neutral is not None]
    found: NDArray[np.bool_] = np.any([values[p.name] != p.neutral for p in switches], axis=0)
    return found
