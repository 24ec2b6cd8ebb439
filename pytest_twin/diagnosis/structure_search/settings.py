"""Settings of the structure search: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StructureSearchSettings:
    """Thresholds and bounds of one structure search.

    Attributes:
        rounds: largest number of models that are accepted one after another.
        added: largest number of effects that one step adds. Two effects may only help together.
        beam: sets that the beam search keeps for each number of effects.
        proposals: models that one step simulates.
        of_one_effect: number of them with one effect. A right effect with one parameter can be
            behind more flexible wrong ones in the linearized motion, until all are simulated.
        of_each_count: number of them with each larger number of effects.
        of_each_elastic: number of them with each number of effects and an elastic transmission.
            Twice as many of each kind are fitted in the linearized motion for more than one
            iteration.
        finalists: simulated models that are fitted.
        corrections: simulations of one fit in the linearized motion.
        refinements: iterations of the final fit by simulation.
        simulated_at_all_sizes: candidates that are simulated at all sizes of their grid, where the
            linearization explains nothing of the residual. All others have one size.
        scan_above: share of the incumbent's mean squared residual in a signal. If the best
            simulated proposal leaves more, the starts that effects propose are simulated.
        earns: penalized log-likelihood ratio that a larger model must gain. 5 are odds of 150 to 1,
            which are called very strong evidence (Kass, Raftery 1995).
        share: share of the log-likelihood ratio between a model and the nominal model that
            additional effects must gain, in all signals together or in one of them.
    """

    rounds: int = 12
    added: int = 3
    beam: int = 8
    proposals: int = 12
    of_one_effect: int = 8
    of_each_count: int = 4
    of_each_elastic: int = 2
    finalists: int = 5
    corrections: int = 3
    refinements: int = 3
    simulated_at_all_sizes: int = 4
    scan_above: float = 0.25
    earns: float = 5.0
    share: float = 0.1


SETTINGS = StructureSearchSettings()
