"""Settings of the comparison with equivalent sets: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EquivalentSetSettings:
    """Bounds of the search for other sets of effects that explain the recordings as well.

    They were chosen on simulated development cases, so that the comparison takes less than the
    search before it. Evidence is a log-likelihood ratio.

    Attributes:
        most_simulations: of all recordings, that the comparison takes. What it saves is not needed
            again.
        largest: effects of a subset that is taken out of the final set.
        most_subsets: subsets: single effects, whole joints, pairs, triples.
        single: single effects that a beam search begins with.
        children: children of each larger set.
        grown: sets that are grown.
        of_size: for each subset, sets of one, two and three effects that are kept; of one effect as
            many again that may be reported.
        fitted_along_motion: sets that are fitted along the linearized motion, of all subsets.
        starts: starts of one set.
        similar: share of the square of a change by effects of the final set, from which a single
            effect that predicts it is simulated instead of them: most of it.
        closest: sets of this kind that are simulated, those with the fewest parameters first.
        simulated: sets that are simulated before they are fitted.
        with_same_parameters: of these, sets with the parameters of the effects that they replace.
        with_fewer_effects: of these, sets with fewer effects.
        kept_by_step: sets that remain for each step of the fit.
        far_behind: evidence behind the final set beyond which no other remains after one step.
        nearly_all: share of the evidence that a set gains over the worst one, from which a smaller
            set within it explains nearly as much.
        ahead: evidence by which another set must be ahead to replace the final one.
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
    with_fewer_effects: int = 3
    kept_by_step: tuple[int, ...] = (6, 4, 3)
    far_behind: float = 400.0
    nearly_all: float = 0.9
    ahead: float = 0.5


EQUIVALENT = EquivalentSetSettings()
