"""Search of contact parameters: short stretches around contacts first, then whole tosses.

The error over a whole toss is not smooth in the parameters: an impact a hair earlier tips the
object to another face. Over a few samples around one contact it is nearly smooth, and its minimum
leads to the right valley (multiple shooting; Bock, Plitt, 1984). CMA-ES (Hansen, 2016) then follows
the error of whole tosses without derivatives. Each generation is one call of many rollouts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cma
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.identification.contact.loss import Stretch, errors_of, losses
from pytest_twin.identification.contact.parameters import ContactModel

STARTS = 3
"""Starts of the search over stretches: the nominal values, and points of a Sobol sequence."""


@dataclass(frozen=True)
class Evaluated:
    """Parameters that were tried, and what each toss's error was.

    Attributes:
        places: (e, p) on the scales of the parameters.
        losses: (e, t).
    """

    places: FloatArray
    losses: FloatArray

    @property
    def best(self) -> FloatArray:
        """(p,) the place of the least mean error."""
        return np.asarray(self.places[int(np.argmin(self.losses.mean(axis=1)))])


class Loss:
    """Errors of stretches under places of parameters; remembers all that was tried."""

    def __init__(self, contact: ContactModel, stretches: Sequence[Stretch]) -> None:
        self.contact, self.stretches = contact, list(stretches)
        self.size = contact.size
        self.places: list[FloatArray] = []
        self.rows: list[FloatArray] = []

    def __call__(self, places: Sequence[FloatArray]) -> FloatArray:
        """(e, t) errors of each stretch at each place."""
        models = [self.contact.at(self.contact.values(place)) for place in places]
        found = errors_of(models, self.contact.body, self.stretches)
        rows = [losses(one, self.size) for one in found]
        self.places += [np.array(place) for place in places]
        self.rows += rows
        return np.array(rows)

    def evaluated(self) -> Evaluated:
        """Everything that was tried."""
        return Evaluated(np.array(self.places), np.array(self.rows))


def minimized(
    loss: Loss,
    start: FloatArray,
    spread: float,
    generations: int,
    seed: int,
    progress: Callable[[float], None] = lambda fraction: None,
) -> FloatArray:
    """The place of the least mean error that CMA-ES finds.

    Args:
        start: where it begins, on the scales.
        spread: first standard deviation on the scales.
        generations: how many, each of about ten places.
        seed: of the draws, at least 1.
        progress: told the fraction done.
    """
    count = len(start)
    if count == 1:
        # CMA-ES needs two dimensions.
        reach = np.clip(start[0] + spread * np.linspace(-2.0, 2.0, 9), 0.0, 1.0)
        loss([np.array([place]) for place in reach])
        return loss.evaluated().best
    strategy = cma.CMAEvolutionStrategy(
        np.clip(start, 0.02, 0.98),
        spread,
        {"bounds": [0.0, 1.0], "seed": seed, "verbose": -9, "popsize": 6 + 2 * count},
    )
    for generation in range(generations):
        if strategy.stop():
            break
        drawn = strategy.ask()
        strategy.tell(drawn, loss(drawn).mean(axis=1).tolist())
        progress((generation + 1) / generations)
    return np.asarray(np.clip(strategy.result.xfavorite, 0.0, 1.0))


def starts(contact: ContactModel) -> list[FloatArray]:
    """Where the search over stretches begins."""
    from scipy.stats import qmc

    drawn = qmc.Sobol(len(contact.parameters), seed=1).random(4)
    return [contact.start(), *itertools.islice(iter(drawn), STARTS - 1)]
