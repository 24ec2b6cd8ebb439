"""Settings of the comparison of models, one object for each of its stages.

All were chosen on simulated development cases, which are none of the blind cases. Evidence is a
log-likelihood ratio; floors are multiples of a signal's noise floor.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """Bounds and thresholds of the selection of effects.

    Attributes:
        earns: evidence that a change must gain. Less is chance: about 1 in e^5 for one of many
            candidates.
        as_good: share of the evidence for an effect that an alternative with more parameters gains
            by chance.
        most_terms: effects of a model.
        rounds: of elimination, exchange and search.
        clear: evidence of the linearized comparison beyond which no simulation would decide
            otherwise.
        hardly: share of the evidence for an effect by which its alternatives may be behind in the
            linearized comparison and still be simulated.
        disputed: evidence behind the best that the integration error may account for.
        even: evidence within which residuals below the noise floor decide.
        other_form: evidence by which another form of a law with as many parameters must be ahead.
        close: alternatives to one effect that are simulated.
        clearly_less: factor between residuals below the noise floor that counts.
        least_told: share of the noise floor below which residuals are equal.
    """

    earns: float = 5.0
    as_good: float = 0.01
    most_terms: int = 20
    rounds: int = 6
    clear: float = 30.0
    hardly: float = 0.05
    disputed: float = 2000.0
    even: float = 10.0
    other_form: float = 10.0
    close: int = 2
    clearly_less: float = 1.25
    least_told: float = 0.2


@dataclass(frozen=True, slots=True)
class ComparisonSettings:
    """Bounds of the comparison of models by simulation.

    Attributes:
        hopeless: evidence behind the best after the first iterations beyond which a fit ends.
        simulations: of all recordings, that one search may take.
        simulations_per_effect: more of them for each effect that was found.
        effects_counted: effects of one joint that are counted so. Many effects at one joint mean
            that the right one is not in the catalogue.
    """

    hopeless: float = 500.0
    simulations: int = 300
    simulations_per_effect: int = 50
    effects_counted: int = 3


@dataclass(frozen=True, slots=True)
class ExchangeSettings:
    """Bounds of the exchange of effects for others.

    Attributes:
        alternatives: candidates instead of one effect.
        alternatives_to_several: candidates instead of several effects, in all.
        near: evidence behind the model, or behind the first candidate, within which candidates are
            fitted. Effects do not add up where a joint sticks.
        regained: share of the lost evidence from which one of the first candidates is fitted too: a
            grid knows little of the shape of a law.
        first: number of these.
        far_apart: floors that the removal of an elastic transmission leaves, beyond which the
            linearized motion does not apply to its alternatives.
        chance: evidence that more parameters gain by chance, at most.
        general_ahead: share of the evidence for a law by which a more general law must be ahead:
            it follows the errors of the simulator a little, in proportion to what the law does.
        special_behind: share by which a special case of a law may be behind and replace it.
        crowd: effects of one joint up to which every subset is exchanged.
    """

    alternatives: int = 6
    alternatives_to_several: int = 4
    near: float = 100.0
    regained: float = 0.5
    first: int = 2
    far_apart: float = 30.0
    chance: float = 15.0
    general_ahead: float = 0.02
    special_behind: float = 0.01
    crowd: int = 4


SELECTION = SelectionSettings()
COMPARISON = ComparisonSettings()
EXCHANGE = ExchangeSettings()
