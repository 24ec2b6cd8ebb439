"""Verdict of an error budget: whether the frame stays within the task's tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pytest_twin.budget.propagate import Spread
from pytest_twin.budget_spec import BudgetSpec
from pytest_twin.formats.record_fields import Z95

WITHIN, EXCEEDED, UNKNOWN = "within", "exceeded", "unknown"
QUANTITIES = ("position", "rotation")
_WORST_FIRST = (EXCEEDED, UNKNOWN, WITHIN)
_MILLI = {"position": "mm", "rotation": "mrad"}


def assess(
    total: Spread | None,
    unmodelled: Sequence[Mapping[str, Any]],
    spec: BudgetSpec,
    *,
    is_complete: bool = True,
    untested: str = "",
) -> dict[str, Any]:
    """Return the verdict of a budget, with the bound of each quantity against its tolerance.

    The root mean square error combines the displacement at the worst pose by the uncertainty of all
    estimates with the largest held-out error that no estimate explains. The bound is 1.96 times as
    large: a normal error of one direction exceeds it in 5 % of cases, one of several directions
    less often. The tolerance is kept if the bound is below it, and exceeded if the root mean square
    is above it. Between these two it is not known, because held-out errors contain measurement
    noise.

    Args:
        total: displacement by all lines; None if no record affects the frame.
        unmodelled: held-out errors of the records.
        is_complete: whether every record was tried. Otherwise more errors can only exceed the
            tolerance.
        untested: conditions of the task that no record was tested under, as a sentence. The errors
            may then be larger than the stated ones.
    """
    bounds = {
        quantity: _bound(
            quantity,
            None if total is None else getattr(total, f"worst_{quantity}"),
            [entry for entry in unmodelled if entry[quantity] is not None],
            getattr(spec, quantity),
            "not every record was tried before the command ended" if not is_complete else untested,
        )
        for quantity in QUANTITIES
    }
    states = [bound["state"] for bound in bounds.values() if bound["tolerance"] is not None]
    worst_state = next((state for state in _WORST_FIRST if state in states), UNKNOWN)
    return {"verdict": worst_state, "bounds": bounds, "words": _words(bounds)}


def _words(bounds: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each quantity with a tolerance, the worst first."""
    stated = [
        (quantity, bound) for quantity, bound in bounds.items() if bound["tolerance"] is not None
    ]
    if not stated:
        return [f"{UNKNOWN}: budget: tolerance: of twin.yaml states nothing to compare with"]
    stated.sort(key=lambda each: _WORST_FIRST.index(each[1]["state"]))
    return [_sentence(quantity, bound) for quantity, bound in stated]


def _sentence(quantity: str, bound: Mapping[str, Any]) -> str:
    unit = _MILLI[quantity]

    def size(value: float | None) -> str:
        return "unknown" if value is None else f"{1e3 * value:.3g} {unit}"

    unmodelled = "unknown what is not modelled"
    if bound["unmodelled"] is not None:
        unmodelled = f"{size(bound['unmodelled'])} of held-out error that no estimate explains"
        unmodelled += f" ({bound['unmodelled_of']})"
    return (
        f"{bound['state']}: {quantity} error {size(bound['rms'])} RMS, 95 % bound "
        f"{size(bound['bound'])}, allowed {size(bound['tolerance'])}: "
        f"{size(bound['estimated'])} by the uncertainty of the estimates, {unmodelled}; "
        f"{bound['why']}"
    )


def _bound(
    quantity: str,
    estimated: float | None,
    held_out: Sequence[Mapping[str, Any]],
    tolerance: float | None,
    doubt: str,
) -> dict[str, Any]:
    largest = max(held_out, key=lambda entry: entry[quantity]["beyond"], default=None)
    beyond = None if largest is None else float(largest[quantity]["beyond"])
    rms = None
    if estimated is not None or beyond is not None:
        rms = float(((estimated or 0.0) ** 2 + (beyond or 0.0) ** 2) ** 0.5)
    if tolerance is None:
        state, why = UNKNOWN, f"budget: tolerance: of twin.yaml states no {quantity}"
    elif rms is not None and rms > tolerance:
        state, why = EXCEEDED, "the root mean square error is above the tolerance"
    elif doubt:
        state, why = UNKNOWN, doubt
    elif beyond is None:
        state = UNKNOWN
        why = f"no record has a held-out {quantity} error, so unmodelled errors are not known"
    elif rms is not None and Z95 * rms > tolerance:
        state = UNKNOWN
        why = (
            "the root mean square error is below the tolerance, its 95 % bound above; the "
            "held-out error contains measurement noise"
        )
    elif estimated is None:
        state, why = UNKNOWN, "no record of this twin affects the frame"
    else:
        state, why = WITHIN, "the 95 % bound is below the tolerance"
    return {
        "state": state,
        "why": why,
        "rms": rms,
        "bound": None if rms is None else Z95 * rms,
        "tolerance": tolerance,
        "estimated": estimated,
        "unmodelled": beyond,
        "unmodelled_of": None if largest is None else largest["id"],
    }
