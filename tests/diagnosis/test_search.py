"""Rules of the search, on drawn problems whose predictions are linear in all parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from linear_physics import EFFECTS, FLOOR, LinearPhysics, drawn_physics, permuted

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.search.accept import accepts
from pytest_twin.diagnosis.search.model import Model, Pool, PooledModel, evidence_of
from pytest_twin.diagnosis.search.physics import Physics
from pytest_twin.diagnosis.search.posterior import MOST_WITH_ONE_RECORDING, posterior
from pytest_twin.diagnosis.search.search import Search, SearchOutcome
from pytest_twin.estimation.comparison import IncomparableModelsError
from pytest_twin.estimation.deadline import OutOfTime
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term

SEEDS = range(4)
CANDIDATES = [Term(effect, joint) for joint in range(2) for effect in EFFECTS]


def drawn_truth(seed: int, count: int) -> dict[Term, float]:
    """Some candidates with sizes that move the signals by many noise floors."""
    rng = np.random.default_rng([seed, count])
    chosen = rng.permutation(len(CANDIDATES))[:count]
    return {
        CANDIDATES[k]: CANDIDATES[k].parameters[0].starts[0] * rng.uniform(0.5, 1.5) for k in chosen
    }


def truth_of(sizes: dict[Term, float]) -> Hypothesis:
    """The hypothesis with effects of one parameter each."""
    return EMPTY.with_terms({term: np.array([size]) for term, size in sizes.items()})


def searched(physics: LinearPhysics) -> SearchOutcome:
    return Search(physics).run()


def terms_of(found: SearchOutcome) -> set[Term]:
    return set(found.incumbent.hypothesis.terms)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_effects_that_act_are_found_with_their_sizes(seed: int, count: int) -> None:
    truth = drawn_truth(seed, count)
    found = searched(drawn_physics(seed, truth=truth))
    assert terms_of(found) == set(truth)
    hypothesis = found.incumbent.hypothesis
    for term, value in truth.items():
        (size,) = hypothesis.theta[hypothesis.slice_of(term)]
        assert size == pytest.approx(value, rel=0.05)
    assert min(posterior(found).confidence.values()) > 0.95


@pytest.mark.parametrize("seed", range(12))
def test_noise_alone_has_no_effect(seed: int) -> None:
    assert terms_of(searched(drawn_physics(seed))) == set()


@pytest.mark.parametrize("seed", range(12))
def test_a_disturbance_that_no_effect_explains_has_no_name(seed: int) -> None:
    assert terms_of(searched(drawn_physics(seed, disturbance=5.0))) == set()


@pytest.mark.parametrize("size", [3.0, 8.0, 20.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_slow_disturbance_of_one_recording_has_no_name(seed: int, size: float) -> None:
    """So slow that the recording has two blocks only."""
    physics = drawn_physics(seed, recordings=1, samples=120)
    cycles = 0.7 * np.linspace(0.0, 1.0, 120)[:, None] + np.random.default_rng(seed).uniform(size=2)
    slow = size * FLOOR * np.sin(2.0 * np.pi * cycles)
    assert terms_of(searched(replace(physics, measured=physics.measured + slow))) == set()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_disturbance_beside_the_truth_adds_no_effect(seed: int) -> None:
    truth = drawn_truth(seed, 1)
    assert terms_of(searched(drawn_physics(seed, truth=truth, disturbance=3.0))) == set(truth)


@pytest.mark.parametrize("seed", SEEDS)
def test_equal_predictions_share_the_confidence(seed: int) -> None:
    delay, rival = Term("command_delay", 0), Term("sensor_delay", -1)
    physics = drawn_physics(seed, truth={delay: 0.02}, alike={rival: delay})
    found = searched(physics)
    (named,) = terms_of(found)
    assert named in (delay, rival)
    shares = posterior(found)
    assert shares.confidence[named] == pytest.approx(0.5, abs=0.02)
    assert set(shares.alternatives[named][0].new) == {delay, rival} - {named}


@pytest.mark.parametrize("seed", SEEDS)
def test_a_sharing_effect_takes_nothing_from_an_independent_one(seed: int) -> None:
    delay, rival = Term("command_delay", 0), Term("sensor_delay", -1)
    friction = Term("viscous_friction", 1)
    physics = drawn_physics(seed, truth={delay: 0.02, friction: 0.2}, alike={rival: delay})
    found = searched(physics)
    shares = posterior(found)
    assert shares.confidence[friction] > 0.95
    (named,) = terms_of(found) - {friction}
    assert shares.confidence[named] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("seed", SEEDS)
def test_two_pairs_of_equal_predictions_share_within_each_pair(seed: int) -> None:
    alike = {Term("quadratic_drag", j): Term("viscous_friction", j) for j in (0, 1)}
    truth = {Term("viscous_friction", j): 0.2 for j in (0, 1)}
    found = searched(drawn_physics(seed, truth=truth, alike=alike))
    shares = posterior(found).confidence
    assert {t.joint for t in shares} == {0, 1}
    assert list(shares.values()) == pytest.approx([0.5, 0.5], abs=0.03)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_incumbent_scores_better_than_the_one_before(seed: int) -> None:
    found = searched(drawn_physics(seed, truth=drawn_truth(seed, 3), disturbance=2.0))
    assert (np.diff(found.incumbents) > 0.0).all()
    assert found.incumbents[0] == found.nominal.score


@pytest.mark.parametrize("seed", SEEDS)
def test_a_limit_selects_a_prefix_of_the_incumbents(seed: int) -> None:
    physics = drawn_physics(seed, truth=drawn_truth(seed, 3))
    whole = searched(physics)
    for limit in np.linspace(1, physics.simulations, 4, dtype=int):
        search = Search(limited := replace(physics, before_simulation=lambda count: None))

        def stop(count: int, limited: LinearPhysics = limited, limit: int = int(limit)) -> None:
            if limited.simulations + count > limit:
                raise OutOfTime

        limited.before_simulation = stop
        found = search.run()
        assert found.incumbents == whole.incumbents[: len(found.incumbents)]


def test_an_earlier_answer_is_the_result_where_no_time_is_left_to_fit_it() -> None:
    truth = drawn_truth(0, 2)
    physics = drawn_physics(0, truth=truth)
    whole = searched(physics)
    search = Search(physics)
    earlier = search.simulated(whole.incumbent.hypothesis)

    def stop(count: int) -> None:
        raise OutOfTime

    physics.before_simulation = stop
    found = search.run([earlier])
    assert not found.is_complete
    assert terms_of(found) == set(truth)


@pytest.mark.parametrize("seed", SEEDS)
def test_an_answer_from_one_recording_that_leaves_much_is_compared_with_all_others(
    seed: int,
) -> None:
    truth = {Term("viscous_friction", 0): 1.0, Term("coulomb_friction", 0): 1.0}
    physics = drawn_physics(seed, truth=truth)
    wrong = Term("armature", 0)
    imitated = sum(physics.responses[t] for t in truth)
    physics.responses = {**physics.responses, wrong: 0.3 * physics.responses[wrong] + imitated}
    incumbents: list[Model] = []
    search = Search(physics, check=incumbents.append)
    found = search.run(tentative=[search.simulated(EMPTY.with_term(wrong, np.ones(1)))])
    assert {wrong} not in [set(m.hypothesis.terms) for m in incumbents]
    assert terms_of(found) == set(truth)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stopped_search_is_no_surer_of_a_wrong_effect(seed: int) -> None:
    truth = drawn_truth(seed, 2)
    physics = drawn_physics(seed, truth=truth)
    whole = posterior(searched(physics)).confidence
    stopped = Search(physics).run(rounds=1)
    for term, confidence in posterior(stopped).confidence.items():
        if term not in truth:
            assert confidence <= max(whole.get(term, 0.0), 0.5) + 1e-9


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("disturbance", "is_sure"), [(0.0, True), (3.0, False)], ids=["noise alone", "a residual"]
)
def test_a_search_that_a_limit_ends_is_sure_if_noise_remains_and_all_rivals_were_compared(
    seed: int, disturbance: float, is_sure: bool
) -> None:
    truth = drawn_truth(seed, 2)
    physics = drawn_physics(seed, truth=truth, disturbance=disturbance)

    def stop(hypothesis: Hypothesis, *, is_explained: bool) -> Iterator[Physics]:
        raise OutOfTime

    physics.other_settings = stop  # type: ignore[method-assign]
    found = searched(physics)
    assert not found.is_complete
    assert terms_of(found) == set(truth)
    # What remains may come from effects that a whole search would find.
    assert (min(posterior(found).confidence.values()) > 0.95) is is_sure


@dataclass
class SettledPhysics(LinearPhysics):
    """A robot with other settings of its simulation."""

    others: list[Physics] = field(default_factory=list)

    def other_settings(self, hypothesis: Hypothesis, *, is_explained: bool) -> Iterator[Physics]:
        yield from self.others


@dataclass
class EarlyPhysics(SettledPhysics):
    """A robot whose first fit of a set of effects ends at the noise floor, above the noise."""

    begun: set[frozenset[Term]] = field(default_factory=set)

    @property
    def noise(self) -> FloatArray:
        return 0.4 * self.floor

    def fit(
        self, hypothesis: Hypothesis, residual: FloatArray, iterations: int,
        corrected_at: Hypothesis,
    ) -> tuple[Hypothesis, FloatArray, FloatArray]:  # fmt: skip
        found, left, jacobian = super().fit(hypothesis, residual, iterations, corrected_at)
        terms = frozenset(found.terms)
        if terms not in self.begun and terms:
            self.begun.add(terms)
            size = np.sqrt(np.mean(jacobian[..., 0] ** 2))
            theta = found.theta.copy()
            theta[0] += 0.7 * FLOOR / size
            found = found.with_theta(theta)
            left = self.measured - self.change(found)
        return found, left, jacobian


@pytest.mark.parametrize("seed", SEEDS)
def test_a_fit_that_ended_early_is_no_reason_for_another_setting(seed: int) -> None:
    drawn = drawn_physics(seed, truth=drawn_truth(seed, 2), noise=0.4)
    own, other = (
        EarlyPhysics(drawn.joints, drawn.measured, drawn.responses, drawn.lengths, drawn.recordings)
        for _ in range(2)
    )
    own.others.append(other)
    other.begun = own.begun
    found = searched(own)
    assert found.physics is own
    assert terms_of(found) == set(drawn_truth(seed, 2))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("disturbance", "is_adopted"), [(20.0, False), (0.0, True)])
def test_a_setting_that_fits_little_of_a_large_residual_is_not_adopted(
    seed: int, disturbance: float, is_adopted: bool
) -> None:
    """The other setting explains a slow error of 3 noise floors, alone or beside a larger one."""
    truth = drawn_truth(seed, 2)
    error = drawn_physics(seed, disturbance=3.0, noise=0.0).measured
    rest = drawn_physics(seed, truth=truth, disturbance=disturbance)
    own, other = (
        SettledPhysics(rest.joints, measured, rest.responses, rest.lengths, rest.recordings)
        for measured in (rest.measured + error, rest.measured)
    )
    own.others.append(other)
    assert (searched(own).physics is other) is is_adopted


@pytest.mark.parametrize("seed", SEEDS)
def test_an_effect_that_acts_in_one_of_two_recordings_is_found_but_not_certain(seed: int) -> None:
    friction, delay = Term("viscous_friction", 0), Term("command_delay", 1)
    physics = drawn_physics(seed, truth={friction: 0.2, delay: 0.02})
    samples = np.repeat(physics.recordings, physics.lengths) > 0
    before = physics.change(truth_of({friction: 0.2}))
    physics.responses[friction][samples] *= 1e-3
    physics.measured += physics.change(truth_of({friction: 0.2})) - before
    found = searched(physics)
    assert terms_of(found) == {friction, delay}
    shares = posterior(found).confidence
    assert shares[friction] <= MOST_WITH_ONE_RECORDING < shares[delay]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_joints_and_candidates_changes_nothing(seed: int) -> None:
    physics = drawn_physics(seed, truth=drawn_truth(seed, 2), disturbance=2.0)
    found, other = searched(physics), searched(permuted(physics, [1, 0]))
    swapped = {Term(t.effect, 1 - t.joint if t.joint >= 0 else -1) for t in terms_of(other)}
    assert swapped == terms_of(found)
    assert other.incumbent.score == pytest.approx(found.incumbent.score, rel=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_order_of_recordings_changes_nothing(seed: int) -> None:
    physics = drawn_physics(seed, truth=drawn_truth(seed, 2), disturbance=2.0)
    samples = physics.lengths[0]
    order = np.concatenate([np.arange(k * samples, (k + 1) * samples) for k in (2, 0, 1)])
    other = replace(
        physics,
        measured=physics.measured[order],
        responses={t: r[order] for t, r in physics.responses.items()},
    )
    found, again = searched(physics), searched(other)
    assert terms_of(found) == terms_of(again)
    assert again.incumbent.score == pytest.approx(found.incumbent.score, rel=1e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_one_recording_gives_no_confidence_above_nine_tenths(seed: int) -> None:
    truth = drawn_truth(seed, 1)
    found = searched(drawn_physics(seed, truth=truth, recordings=1, samples=900))
    assert terms_of(found) == set(truth)
    assert max(posterior(found).confidence.values()) <= MOST_WITH_ONE_RECORDING


@pytest.mark.parametrize("seed", SEEDS)
def test_an_effect_that_acts_in_one_recording_only_is_not_accepted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    physics = drawn_physics(seed, recordings=4)
    only = Term("viscous_friction", 0)
    inside = np.arange(len(physics.measured)) < physics.lengths[0]
    measured = physics.measured.copy()
    measured[inside] += 0.2 * rng.choice([-1.0, 1.0]) * physics.responses[only][inside, :, 0]
    found = searched(replace(physics, measured=measured))
    assert only not in terms_of(found)


@pytest.mark.parametrize("seed", SEEDS)
def test_refused_effects_are_never_accepted(seed: int) -> None:
    truth = drawn_truth(seed, 1)
    (term,) = truth
    physics = drawn_physics(seed, truth=truth)
    physics.refused = lambda h: {term: "impossible"} if term in h.terms else {}
    assert term not in terms_of(searched(physics))


def test_models_on_other_samples_are_not_compared() -> None:
    long, short = (Search(drawn_physics(0, samples=n)) for n in (300, 200))
    with pytest.raises(IncomparableModelsError, match="600 samples"):
        long.comparison.gain(long.nominal.predicted, short.nominal.predicted)


def test_a_richer_model_with_the_same_prediction_is_not_accepted() -> None:
    truth = drawn_truth(1, 1)
    search = Search(drawn_physics(1, truth=truth))
    found = search.run()
    other = next(t for t in CANDIDATES if t not in truth)
    richer = found.incumbent.hypothesis.with_term(other, np.zeros(1))
    (residual,) = search.physics.simulate([richer], EMPTY)
    model = replace(
        found.incumbent, hypothesis=richer, residual=residual, size=search.physics.size(richer)
    )
    assert not accepts(model, found.incumbent, found.nominal, search.comparison).is_accepted


def test_the_noise_floor_of_the_drawn_problems_is_that_of_their_noise() -> None:
    physics = drawn_physics(0)
    assert physics.measured.std(axis=0) == pytest.approx([FLOOR, FLOOR], rel=0.1)


@pytest.mark.parametrize(("worse", "share"), [(1.0, 0.5), (-1.0, 0.05)])
def test_a_rival_that_fits_better_is_likelier_only_if_it_predicts_better(
    worse: float, share: float
) -> None:
    """Its evidence is larger by log(20); its cross-validated score is lower, or higher."""
    friction, delay = Term("viscous_friction", 0), Term("command_delay", 0)
    found = searched(drawn_physics(0, truth={friction: 0.2}, disturbance=3.0))
    incumbent = found.incumbent
    assert set(incumbent.hypothesis.terms) == {friction}
    rival = PooledModel(
        truth_of({delay: 0.02}), incumbent.size,
        evidence_of(found.comparison, incumbent.mean_square, incumbent.size) + np.log(20.0),
        score=incumbent.score - worse,
    )  # fmt: skip

    class OneRival(Pool):
        def rivals_of(self, incumbent: Model) -> Iterator[PooledModel]:
            yield rival

    shares = posterior(replace(found, pool=OneRival(found.comparison)))
    assert shares.confidence[friction] == pytest.approx(share, abs=0.01)
