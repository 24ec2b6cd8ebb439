"""Settings of the search: each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Bounds and thresholds of one search. Evidence is a log-likelihood ratio.

    Attributes:
        rounds: largest number of rounds. Each accepts at most one model.
        added: largest number of effects that one round adds. Two effects may only help together.
        beam: sets that the beam search keeps for each number of effects.
        proposals: models that one round simulates.
        of_one_effect: number of them with one effect. A right effect with one parameter can be
            behind more flexible wrong ones in the linearized motion, until all are simulated.
        of_each_count: number of them with each larger number of effects.
        of_each_elastic: number of them with each number of effects and an elastic transmission.
        finalists: simulated models that are fitted.
        corrections: simulations of one fit in the linearized motion.
        refinements: iterations of the fit by simulation.
        contenders: models of one round that may be accepted.
        rivals: alternatives to the effects of the last incumbent that are simulated.
        fitted_rivals: number of them that are fitted by simulation.
        rival_within: evidence by which a rival may be behind the incumbent to be fitted.
        scan_above: share of the incumbent's mean squared residual in a signal. If the best
            simulated proposal leaves more, the starts that effects propose are simulated.
        earns: evidence that a richer model must gain. 5 are odds of 150 to 1, which are called very
            strong (Kass, Raftery 1995).
        share: share of the log-likelihood ratio between a model and the nominal model that more
            effects must gain, in all signals together or in one of them. A wrong effect reduces a
            little of what an inexact one leaves.
        standard_errors: standard errors of the paired difference by which a richer model must
            predict better.
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
    contenders: int = 8
    rivals: int = 12
    fitted_rivals: int = 3
    rival_within: float = 30.0
    scan_above: float = 0.1
    earns: float = 5.0
    share: float = 0.1
    standard_errors: float = 1.0


SETTINGS = SearchSettings()
