"""Fit contact parameters of a free object to whole tosses and test them on held-out tosses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import RecordingError
from pytest_twin.estimation.covariance import small_sample_factor
from pytest_twin.identification.contact.loss import (
    Stretch,
    TossErrors,
    around_contacts,
    errors_of,
    losses,
    whole_toss,
)
from pytest_twin.identification.contact.parameters import (
    FRICTION,
    ROLLING,
    TORSIONAL,
    ContactModel,
)
from pytest_twin.identification.contact.search import Loss, minimize, starts
from pytest_twin.identification.contact.tosses import Toss
from pytest_twin.identification.contact.uncertainty import (
    UNDETERMINED,
    BootstrapMinimum,
    bootstrap_minimum,
    by_toss,
    is_as_good,
    surface,
)
from pytest_twin.time_limit import skips

SAMPLES = 12
"""Number of samples of a segment around a contact. At 148 Hz it lasts 75 ms: one impact and the
motion that follows."""
_STRETCHES = 240
"""Largest number of segments for the search. More take longer and hardly reduce the intervals."""
_MOST_SPARE = 3.0
"""Largest factor by which the search is extended if there are few segments, which cost less."""
_WHOLE = 60
"""Number of whole tosses in the second search."""
_GENERATIONS = {"stretches": 15, "whole": 8, "variant": 6}
"""Search -> number of generations of CMA-ES."""
_SPINNING = (0.0003, 0.002, 0.01)
"""Tested coefficients of torsional and rolling friction, relative to 10 times the object's half
size."""
_FAR = 2.0 * UNDETERMINED
"""Distance on a parameter's scale, with the others fixed, at which the error must be larger for the
parameter to have an influence."""
_PROFILED, _TRIED, _REFINEMENTS = 9, 17, 3
"""Values of a fixed parameter, and values of its partner that are tried in each refinement: the
last one resolves 1/512 of the partner's range."""
_AS_WELL = 0.01
"""Smallest relative increase of the error that counts as larger. The simulation is deterministic,
but friction can compensate noise of the measured initial velocities."""


@dataclass(frozen=True)
class Variant:
    """Result of the fit with other simulation options.

    Attributes:
        values: parameter -> value that fits best with this option.
        held: error on held-out tosses with these values.
        kept: error on held-out tosses with the values of the main fit.
        is_another_law: whether the option changes the law of friction, not only its accuracy.
    """

    name: str
    values: Mapping[str, float]
    held: TossErrors
    kept: TossErrors
    is_another_law: bool = False


@dataclass(frozen=True)
class UndeterminedCombination:
    """A combination of parameters that the tosses do not determine.

    Attributes:
        loadings: parameter -> component of the unit vector, on the scales of the search.
        fixed: parameter that was fixed to remove the combination.
        value: value at which it was fixed.
    """

    loadings: Mapping[str, float]
    fixed: str
    value: float


@dataclass(frozen=True)
class ContactFit:
    """Fitted contact parameters with their prediction errors.

    Attributes:
        contact: contact model with its free parameters.
        values: parameter -> value, of free and fixed parameters.
        names: free parameters, in the order of the covariance.
        covariance: (p, p) covariance of the free parameters, in their units.
        without_effect: friction coefficients without significant effect on the predictions.
        nominal, fitted: errors on the fit tosses.
        nominal_held, fitted_held: errors on the held-out tosses.
        variants: results with other simulation options.
        is_refined: whether the search on whole tosses changed the estimate.
    """

    contact: ContactModel
    values: Mapping[str, float]
    names: tuple[str, ...]
    covariance: FloatArray
    undetermined: tuple[UndeterminedCombination, ...]
    without_effect: tuple[str, ...]
    nominal: TossErrors
    fitted: TossErrors
    nominal_held: TossErrors
    fitted_held: TossErrors
    variants: tuple[Variant, ...] = ()
    is_refined: bool = False
    notes: tuple[str, ...] = field(default=())


def fit_contact(
    contact: ContactModel,
    fit: Sequence[Toss],
    held_out: Sequence[Toss],
    progress: Callable[[float], None] = lambda fraction: None,
) -> ContactFit:
    """Fit contact parameters, test them on held-out tosses, and repeat with other options.

    Args:
        contact: nominal model with its free parameters.
        fit, held_out: whole tosses; the latter may be empty.
        progress: called with the fraction done.

    Raises:
        RecordingError: no toss contains a contact.
    """
    gravity = np.array(contact.model.opt.gravity)
    stretches, groups = _draw_segments(around_contacts(fit, gravity, SAMPLES, contact.size), fit)
    loss = Loss(contact, stretches)
    found, rivals = _minima(contact, loss, groups, lambda f: progress(0.45 * f))
    spinning: tuple[str, ...] = ()
    if not skips("torsional and rolling friction"):
        contact, spinning = _with_spinning(contact, found, stretches, groups)
    if len(contact.parameters) > len(found):
        extra = [one.place(one.start) for one in contact.parameters[len(found) :]]
        loss = Loss(contact, stretches)
        seed = np.concatenate([found, extra])
        found = minimize(loss, seed, 0.05, _GENERATIONS["stretches"], 2)
        rivals = []
    equivalent: list[Sequence[FloatArray]] = [rivals]
    around = surface(loss, found, groups)
    free, undetermined = list(range(len(found))), list[UndeterminedCombination]()
    for gone in _without_influence(loss, found, groups)[: len(found) - 1]:
        name = contact.names[gone]
        value = contact.parameters[gone].value(float(found[gone]))
        undetermined.append(UndeterminedCombination({name: 1.0}, name, value))
        free.remove(gone)
    known = bootstrap_minimum(around, free, equivalent)
    while known.undetermined and len(free) > 1:
        removed, combination = _fix_undetermined(contact, around.centre, free, known)
        undetermined.append(combination)
        free.remove(removed)
        partner = max(free, key=lambda at: abs(combination.loadings[contact.names[at]]))
        equivalent.append(_compensate(loss, found, removed, partner, groups))
        known = bootstrap_minimum(around, free, equivalent)
    progress(0.6)
    places = around.centre.copy()
    places[free] = known.centre
    values = contact.values(places)
    rest = contact.without([one.fixed for one in undetermined], values)
    rows = [whole_toss(one) for one in fit]
    places, covariance, refined = _refine(rest, places[free], known.covariance, rows)
    values = {**values, **rest.values(places)}
    progress(0.75)
    held = [whole_toss(one) for one in held_out]
    nominal, fitted = errors_of([contact.model, contact.at(values)], contact.body, rows)
    nominal_held, fitted_held = (
        errors_of([contact.model, contact.at(values)], contact.body, held)
        if held
        else (TossErrors(np.zeros(0), np.zeros(0)),) * 2
    )
    slopes = np.diag([p.slope(place) for p, place in zip(rest.parameters, places, strict=True)])
    some = np.random.default_rng(5).permutation(len(stretches))[: _STRETCHES // 2]
    variants = _variants(rest, places, values, [stretches[at] for at in some], held, progress)
    return ContactFit(
        contact, values, rest.names, slopes @ covariance @ slopes, tuple(undetermined),
        tuple(name for name in (TORSIONAL, ROLLING) if name not in spinning),
        nominal, fitted, nominal_held, fitted_held, tuple(variants), refined,
    )  # fmt: skip


def _draw_segments(
    each: Sequence[Sequence[Stretch]], fit: Sequence[Toss]
) -> tuple[list[Stretch], list[int]]:
    """Draw segments from all tosses; return them with the index of their toss."""
    pairs = [(at, one) for at, rows in enumerate(each) for one in rows]
    if len({at for at, _ in pairs}) < 2:
        raise RecordingError(
            "fewer than two of the fitted tosses touch a surface",
            path=fit[0].path,
            expected="tosses that reach the surface while the object moves",
        )
    order = np.random.default_rng(0).permutation(len(pairs))[:_STRETCHES]
    chosen = [pairs[at] for at in sorted(order)]
    return [one for _, one in chosen], [at for at, _ in chosen]


def _minima(
    contact: ContactModel,
    loss: Loss,
    groups: Sequence[int],
    progress: Callable[[float], None],
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the best minimum over all starts, and other minima that predict equally well."""
    begun = starts(contact)
    minima = [
        minimize(loss, start, 0.25, _GENERATIONS["stretches"], 1 + at,
                  lambda f, at=at: progress((at + f) / len(begun)))  # type: ignore[misc]
        for at, start in enumerate(begun)
    ]  # fmt: skip
    means = by_toss(loss(minima), groups)
    order = np.argsort(means.mean(axis=1))
    best = int(order[0])
    others = [minima[at] for at in order[1:]]
    spare = min(_STRETCHES / len(loss.stretches) - 1.0, _MOST_SPARE)
    more = round(_GENERATIONS["stretches"] * spare)
    polished = minima[best] if more < 1 else minimize(loss, minima[best], 0.08, more, 7)
    kept = _mean(loss, polished, groups)
    return polished, [at for at in others if is_as_good(kept, _mean(loss, at, groups))]


def _mean(loss: Loss, place: FloatArray, groups: Sequence[int]) -> FloatArray:
    return np.asarray(by_toss(loss([place]), groups)[0])


def _with_spinning(
    contact: ContactModel, places: FloatArray, stretches: Sequence[Stretch], groups: Sequence[int]
) -> tuple[ContactModel, tuple[str, ...]]:
    """Return the model with torsional and rolling friction free if they reduce the error."""
    from dataclasses import replace

    from pytest_twin.identification.contact.parameters import Parameter

    values, size = contact.values(places), contact.size
    tried = [(name, 10.0 * share * size) for name in (TORSIONAL, ROLLING) for share in _SPINNING]
    models = [contact.at(values), *(contact.at({**values, name: v}) for name, v in tried)]
    found = [losses(one, size) for one in errors_of(models, contact.body, list(stretches))]
    means = by_toss(np.array(found), groups)
    chosen: dict[str, float] = {}
    for row, (name, value) in enumerate(tried, 1):
        gain = means[0] - means[row]
        # Six values are tested: a bound of three standard errors is a joint level of 98 %.
        beyond = (
            3.0 * small_sample_factor(len(gain), 3.0) * np.std(gain, ddof=0) / np.sqrt(len(gain))
        )
        if np.mean(gain) > beyond:
            chosen.setdefault(name, value)
    added = tuple(Parameter(name, 1e-5 * size, size, value) for name, value in chosen.items())
    return replace(contact, parameters=(*contact.parameters, *added)), tuple(chosen)


def _without_influence(loss: Loss, found: FloatArray, groups: Sequence[int]) -> list[int]:
    """Return parameters without influence on the error, such as friction while pressing.

    In the quadratic approximation such a direction contains noise of the other parameters and would
    make them seem undetermined.
    """
    here = float(_mean(loss, found, groups).mean())
    inert = []
    for k in range(len(found)):
        moved = np.array([at for at in (found[k] - _FAR, found[k] + _FAR) if 0.0 <= at <= 1.0])
        places = np.tile(found, (len(moved), 1))
        places[:, k] = moved
        there = by_toss(loss(list(places)), groups).mean(axis=1)
        if there.min() <= (1.0 + _AS_WELL) * here:
            inert.append(k)
    return inert


def _fix_undetermined(
    contact: ContactModel, centre: FloatArray, free: Sequence[int], known: BootstrapMinimum
) -> tuple[int, UndeterminedCombination]:
    """Choose and fix the parameter that represents an undetermined combination."""
    direction = known.undetermined[-1]
    # Friction is not chosen if other parameters take part, because most contacts determine it best.
    # Pressing does not determine it; the direction then consists of friction alone.
    order = np.argsort(-np.abs(direction))
    shared = [k for k in order if abs(direction[k]) > 0.5 * abs(direction[order[0]])]
    at = next((k for k in shared if contact.names[free[k]] != FRICTION), order[0])
    loadings = {contact.names[free[k]]: float(direction[k]) for k in range(len(free))}
    removed = free[at]
    value = contact.parameters[removed].value(float(centre[removed]))
    return removed, UndeterminedCombination(loadings, contact.names[removed], value)


def _compensate(
    loss: Loss, found: FloatArray, removed: int, partner: int, groups: Sequence[int]
) -> list[FloatArray]:
    """Return positions with other values of a fixed parameter that predict the tosses as well.

    A fixed parameter that is not identified may have any other value. The parameter that
    compensates for it best is refitted to each value (profile likelihood; Raue et al. 2009), so
    that its interval contains what the fixed value might change.

    Args:
        found: (p,) minimum, on the scales.
        removed, partner: indices of the fixed parameter and of the one that compensates for it.
        groups: (s,) index of the toss of each segment.
    """
    kept = _mean(loss, found, groups)
    values = np.linspace(0.0, 1.0, _PROFILED)
    best, reach = np.full(_PROFILED, found[partner]), 1.0
    means = np.empty((_PROFILED, len(kept)))
    for _ in range(_REFINEMENTS):
        tried = best[:, None] + reach * np.linspace(-1.0, 1.0, _TRIED)
        places = np.tile(found, (_PROFILED, _TRIED, 1))
        places[..., removed] = values[:, None]
        places[..., partner] = np.clip(tried, 0.0, 1.0)
        errors = by_toss(loss(list(places.reshape(-1, len(found)))), groups)
        errors = errors.reshape(_PROFILED, _TRIED, -1)
        lowest = np.argmin(errors.mean(axis=2), axis=1)
        rows = np.arange(_PROFILED)
        best, means = places[rows, lowest, partner], errors[rows, lowest]
        reach *= 2.0 / (_TRIED - 1)
    out = []
    for value, place, mean in zip(values, best, means, strict=True):
        if is_as_good(kept, mean):
            other = found.copy()
            other[removed], other[partner] = value, place
            out.append(other)
    return out


def _refine(
    contact: ContactModel, places: FloatArray, covariance: FloatArray, rows: Sequence[Stretch]
) -> tuple[FloatArray, FloatArray, bool]:
    """Refine the estimate on whole tosses; keep the result if it predicts significantly better."""
    if skips("the refinement on whole tosses"):
        return places, covariance, False
    some = np.random.default_rng(4).permutation(len(rows))[:_WHOLE]
    search = Loss(contact, [rows[at] for at in some])
    moved = minimize(search, places, 0.05, _GENERATIONS["whole"], 3)
    models = [contact.at(contact.values(one)) for one in (places, moved)]
    before, after = (
        losses(one, contact.size) for one in errors_of(models, contact.body, list(rows))
    )
    if is_as_good(after, before):
        return places, covariance, False
    apart = moved - places
    return moved, covariance + np.outer(apart, apart), True


def variants_of(model: mujoco.MjModel) -> dict[str, dict[str, Any]]:
    """Return the simulation options with which the fit is repeated, one change each."""
    step = float(model.opt.timestep)
    elliptic = int(model.opt.cone) == int(mujoco.mjtCone.mjCONE_ELLIPTIC)
    euler = int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_EULER)
    cone = ("pyramidal", mujoco.mjtCone.mjCONE_PYRAMIDAL) if elliptic else (
        "elliptic", mujoco.mjtCone.mjCONE_ELLIPTIC)  # fmt: skip
    other = ("implicitfast", mujoco.mjtIntegrator.mjINT_IMPLICITFAST) if euler else (
        "Euler", mujoco.mjtIntegrator.mjINT_EULER)  # fmt: skip
    return {
        f"timestep {0.5e3 * step:g} ms": {"timestep": 0.5 * step},
        f"{cone[0]} cone": {"cone": cone[1]},
        f"integrator {other[0]}": {"integrator": other[1]},
    }


def _variants(
    contact: ContactModel,
    places: FloatArray,
    values: Mapping[str, float],
    stretches: Sequence[Stretch],
    held: Sequence[Stretch],
    progress: Callable[[float], None],
) -> list[Variant]:
    found = []
    changes = variants_of(contact.model)
    for done, (name, change) in enumerate(changes.items(), 1):
        if skips(f"the fit with {name}"):
            continue
        other = contact.with_options(change)
        moved = minimize(Loss(other, stretches), places, 0.08, _GENERATIONS["variant"], 6)
        own = {**values, **other.values(moved)}
        nothing = TossErrors(np.zeros(0), np.zeros(0))
        own_errors, kept_errors = (
            errors_of([other.at(own), other.at(values)], contact.body, held)
            if held
            else [nothing, nothing]
        )
        estimates = {n: own[n] for n in contact.names}
        found.append(Variant(name, estimates, own_errors, kept_errors, "cone" in change))
        progress(0.75 + 0.24 * done / len(changes))
    return found
