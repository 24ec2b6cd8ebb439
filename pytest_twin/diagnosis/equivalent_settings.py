"""Settings of the comparison with equivalent sets: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EquivalentSetSettings:
    """Bounds of the search for other sets of effects that explain the recordings as well.

    They were chosen on simulated development cases, so that the comparison takes less than the
    search before it. Evidence is a log-likelihood ratio.

    Attributes:
        most_simulations: largest number of simulations of all recordings for the comparison.
        largest: largest number of effects in a subset that is removed from the final set.
        most_subsets: largest number of subsets: single effects, whole joints, pairs, triples.
        single: number of single effects with which a beam search begins.
        children: number of children of each larger set.
        grown: number of sets of each size that get one more effect.
        of_size: number of sets of one, two and three effects that are kept for each subset; of one
            effect as many again that may be reported.
        fitted_along_motion: number of sets of all subsets that are fitted in the linearized motion.
        starts: number of starts of one set.
        similar: a single effect is simulated instead of effects of the final set if it predicts at
            least this fraction of the squared change that they cause.
        closest: number of such sets that are simulated, those with the fewest parameters first.
        simulated: number of sets that are simulated before they are fitted.
        with_same_parameters: of these, sets with the parameters of the effects that they replace.
        of_search: of these, sets that the search found nearly as good.
        with_fewer_effects: of these, sets with fewer effects.
        kept_by_step: number of sets that remain at each step of the fit.
        far_behind: difference in evidence to the final set above which a set is dropped after one
            step.
        nearly_all: share of a set's evidence, relative to the worst set, from which a subset of it
            explains nearly as much.
        ahead: smallest gain of evidence for which another set replaces the final one.
    """

    most_simulations: float = 60.0
    largest: int = 3
    most_subsets: int = 24
    single: int = 60
    children: int = 6
    grown: int = 3
    of_size: tuple[int, ...] = (4, 2, 2)
    fitted_along_motion: int = 24
    starts: int = 2
    similar: float = 0.5
    closest: int = 5
    simulated: int = 16
    with_same_parameters: int = 4
    of_search: int = 4
    with_fewer_effects: int = 3
    kept_by_step: tuple[int, ...] = (6, 4, 3)
    far_behind: float = 400.0
    nearly_all: float = 0.9
    ahead: float = 0.5


EQUIVALENT = EquivalentSetSettings()
