"""Settings of the stepwise selection of effects, one object for each of its stages.

All were chosen on simulated development cases, which are none of the blind cases. Evidence is a
log-likelihood ratio; floors are multiples of a signal's noise floor.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """Bounds and thresholds of the stepwise selection.

    Attributes:
        earns: evidence that a change must gain. Less is chance: about 1 in e^5 for one of many
            candidates.
        as_good: share of the best evidence within which a model with fewer parameters wins.
        fewer_as_good: share of the best evidence from which a model with fewer effects wins.
        most_terms: effects of a model.
        rounds: steps forward, backward and sideways.
        attempts: shortlists of one step forward.
        clear: evidence of the linearized comparison beyond which no simulation would decide
            otherwise.
        hardly: share of the evidence for an effect by which its alternatives may be behind in the
            linearized comparison and still be simulated.
        disputed: evidence behind the best that the integration error may account for.
        even: evidence within which residuals below the noise floor decide.
        other_form: evidence by which another form of a law with as many parameters must be ahead.
        close: alternatives to one effect that are simulated.
        linearized_least, linearized_most: least and greatest confidence of an effect that was
            compared with its alternatives in the linearized motion alone. Of 51 such names in blind
            cases that ended after 60 s, 29 were right.
        hurried: models of a shortlist that are simulated once time is over.
        crowd: effects at one joint from which the search is repeated from the strongest of them.
        clearly_less: factor between residuals below the noise floor that counts.
        least_told: share of the noise floor below which residuals are equal.
    """

    earns: float = 5.0
    as_good: float = 0.01
    fewer_as_good: float = 0.8
    most_terms: int = 20
    rounds: int = 6
    attempts: int = 3
    clear: float = 30.0
    hardly: float = 0.05
    disputed: float = 2000.0
    even: float = 10.0
    other_form: float = 10.0
    close: int = 2
    linearized_least: float = 0.2
    linearized_most: float = 0.6
    hurried: int = 4
    crowd: int = 3
    clearly_less: float = 1.25
    least_told: float = 0.2


@dataclass(frozen=True, slots=True)
class ComparisonSettings:
    """Bounds of the comparison of models by simulation.

    Attributes:
        in_race: evidence behind the first model within which others are fitted further.
        finalists: models that are fitted further, at most.
        close_race: share of the best evidence within which models are compared with the integration
            error of each.
        most_close: number of these.
        moved: floors by which that error must change a prediction for another fit.
        hopeless: evidence behind the best after the first iterations beyond which a fit ends.
        rough_rounds: fits of a model whose prediction depends on parameters in leaps.
        simulations: of all recordings, that one search may take.
        simulations_per_effect: more of them for each effect that was found.
        effects_counted: effects of one joint that are counted so. Many effects at one joint mean
            that the right one is not in the catalogue.
    """

    in_race: float = 150.0
    finalists: int = 4
    close_race: float = 0.3
    most_close: int = 3
    moved: float = 0.3
    hopeless: float = 500.0
    rough_rounds: int = 2
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


@dataclass(frozen=True, slots=True)
class ShortlistSettings:
    """Bounds of the shortlists of a step forward.

    Attributes:
        width: models kept for each number of effects.
        added: effects that one step adds, at most.
        fitted: models of each number of effects that are fitted to the linearized motion.
        fitted_alone: single effects that are fitted to it.
        width_around_single: models kept for each number of effects around a fitted single effect.
        near: floors that a single effect may leave before all single effects are simulated.
        simulated_alone: single effects that this keeps.
        narrow: floors (an arm that falls, a command that is never followed) from which laws of one
            parameter are simulated up to their bounds: their minima are narrow.
        limits: limits of drives whose size is refined.
    """

    width: int = 10
    added: int = 4
    fitted: int = 2
    fitted_alone: int = 8
    width_around_single: int = 4
    near: float = 3.0
    simulated_alone: int = 3
    narrow: float = 1000.0
    limits: int = 2


SELECTION = SelectionSettings()
COMPARISON = ComparisonSettings()
EXCHANGE = ExchangeSettings()
SHORTLIST = ShortlistSettings()
