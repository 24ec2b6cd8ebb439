"""Settings of the structure search: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StructureSearchSettings:
    """Thresholds and bounds of one structure search.

    Attributes:
        rounds: models that are accepted one after another, at most.
        added: effects that one step may add. Two effects may each look useless without the other.
        beam: structures kept at each size of the linear search.
        proposals: models of one step that are simulated.
        of_each_count: of these, the best with each number of effects. A right effect alone can be
            behind three wrong ones along the linearized motion (clock drift of 0.5 %: place 14).
        fitted_of_each_count: models with each number of effects that are fitted along the motion
            beyond one iteration: twice what is simulated.
        finalists: of these, models that are fitted.
        corrections: simulations of one fit along the linearized motion.
        refinements: iterations of the final fit by simulated gradients.
        earns: log-likelihood ratio, after the prices of parameters and names, that a larger model
            must gain: the odds of 150 to 1 that are called very strong evidence (Kass, Raftery
            1995) are 5.
        share: of the log-likelihood ratio of a model over the nominal one, that each more effect
            must gain.
    """

    rounds: int = 12
    added: int = 3
    beam: int = 8
    proposals: int = 12
    of_each_count: int = 4
    fitted_of_each_count: int = 8
    finalists: int = 5
    corrections: int = 3
    refinements: int = 3
    earns: float = 5.0
    share: float = 0.1


SETTINGS = StructureSearchSettings()
