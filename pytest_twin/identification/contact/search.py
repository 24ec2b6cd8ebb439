"""Search for contact parameters: first on short segments around contacts, then on whole tosses.

The error over a whole toss is not smooth in the parameters, because a slightly earlier impact can
tip the object to another face. Over a few samples around one contact the error is nearly smooth,
and its minimum lies in the basin of the right solution (multiple shooting; Bock, Plitt, 1984).
CMA-ES (Hansen, 2016) then minimizes the error of whole tosses without derivatives. Each generation
is one batch of rollouts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.contact.loss import Stretch, errors_of, losses
from pytest_twin.identification.contact.parameters import ContactModel
from pytest_twin.time_limit import is_over

_FEWEST_GENERATIONS = 3
"""Generations of a search that ends at the time limit: the curvature at its result needs them."""
STARTS = 3
"""Number of starts of the search over segments: the nominal values and points of a Sobol
sequence."""


@dataclass(frozen=True)
class Evaluations:
    """Evaluated parameters with the error of each segment.

    Attributes:
        places: (e, p) positions on the scales of the parameters.
        losses: (e, t) errors.
    """

    places: FloatArray
    losses: FloatArray

    @property
    def best(self) -> FloatArray:
        """(p,) position with the smallest mean error."""
        return np.asarray(self.places[int(np.argmin(self.losses.mean(axis=1)))])


class Loss:
    """Errors of segments as a function of the parameters; records all evaluations."""

    def __init__(self, contact: ContactModel, stretches: Sequence[Stretch]) -> None:
        self.contact, self.stretches = contact, list(stretches)
        self.size = contact.size
        self.places: list[FloatArray] = []
        self.rows: list[FloatArray] = []

    def __call__(self, places: Sequence[FloatArray]) -> FloatArray:
        """(e, t) errors of each segment at each position."""
        models = [self.contact.at(self.contact.values(place)) for place in places]
        found = errors_of(models, self.contact.body, self.stretches)
        rows = [losses(one, self.size) for one in found]
        self.places += [np.array(place) for place in places]
        self.rows += rows
        return np.array(rows)

    def evaluated(self) -> Evaluations:
        """Return all evaluations."""
        return Evaluations(np.array(self.places), np.array(self.rows))


def minimize(
    loss: Loss,
    start: FloatArray,
    spread: float,
    generations: int,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
) -> FloatArray:
    """Return the position with the smallest mean error that CMA-ES finds.

    Args:
        start: initial mean, on the scales.
        spread: initial standard deviation on the scales.
        generations: number of generations, each of about ten positions.
        seed: seed of the random draws, at least 1.
        progress: called with the fraction done.
    """
    count = len(start)
    if count == 1:
        # CMA-ES needs two dimensions.
        reach = np.clip(start[0] + spread * np.linspace(-2.0, 2.0, 9), 0.0, 1.0)
        loss([np.array([place]) for place in reach])
        return loss.evaluated().best
    # The import takes half a second: it loads matplotlib.
    import cma

    strategy = cma.CMAEvolutionStrategy(
        np.clip(start, 0.02, 0.98),
        spread,
        {"bounds": [0.0, 1.0], "seed": seed, "verbose": -9, "popsize": 6 + 2 * count},
    )
    for generation in range(generations):
        if strategy.stop() or (generation >= _FEWEST_GENERATIONS and is_over()):
            break
        drawn = strategy.ask()
        strategy.tell(drawn, loss(drawn).mean(axis=1).tolist())
        progress((generation + 1) / generations)
    return np.asarray(np.clip(strategy.result.xfavorite, 0.0, 1.0))


def starts(contact: ContactModel) -> list[FloatArray]:
    """Return the initial positions of the search over segments."""
    from scipy.stats import qmc

    drawn = qmc.Sobol(len(contact.parameters), seed=1).random(4)
    return [contact.start(), *itertools.islice(iter(drawn), STARTS - 1)]
