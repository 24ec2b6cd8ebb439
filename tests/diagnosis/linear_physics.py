"""A robot whose predictions are linear in all parameters: a search takes milliseconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.beam_search import CandidateSensitivities, ResidualView
from pytest_twin.diagnosis.first_order.bins import Bins
from pytest_twin.diagnosis.first_order.sensitivities import Sensitivity
from pytest_twin.diagnosis.search.linearized_view import View
from pytest_twin.diagnosis.search.physics import Physics
from pytest_twin.estimation.comparison import Size
from pytest_twin.estimation.hypothesis import Hypothesis, Term
from pytest_twin.estimation.least_squares import fit

FLOOR = 0.01
"""Noise floor of each signal."""


@dataclass
class LinearPhysics:
    """Measurements, and the change of all signals by each parameter of each candidate.

    Attributes:
        joints: names of the joints.
        measured: (samples, joints) difference of the measured signals to the nominal model.
        responses: candidate -> (samples, joints, parameters) change by each parameter.
        lengths, recordings: samples and recording of each segment.
        before_simulation: called with the number of hypotheses before they are simulated.
        refused: whether a hypothesis is refused.
        given: effects that every model of the search has.
    """

    joints: Sequence[str]
    measured: FloatArray
    responses: Mapping[Term, FloatArray]
    lengths: Sequence[int]
    recordings: Sequence[int]
    before_simulation: Callable[[int], None] = lambda count: None
    refused: Callable[[Hypothesis], Mapping[Term, str]] = lambda hypothesis: {}
    given: Sequence[Term] = ()
    simulations: int = field(default=0, init=False)

    @property
    def candidates(self) -> Sequence[Term]:
        return tuple(self.responses)

    @property
    def floor(self) -> FloatArray:
        return np.full(len(self.joints), FLOOR)

    @property
    def noise(self) -> FloatArray:
        return self.floor

    @property
    def is_linearizable(self) -> bool:
        return True

    def change(self, hypothesis: Hypothesis) -> FloatArray:
        """(samples, joints) change of the prediction by a hypothesis."""
        out = np.zeros_like(self.measured)
        for t in hypothesis.terms:
            out += self.responses[t] @ hypothesis.theta[hypothesis.slice_of(t)]
        return out

    def residuals(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[FloatArray]:
        self.before_simulation(len(hypotheses))
        self.simulations += len(hypotheses)
        return [self.measured - self.change(h) for h in hypotheses]

    def simulate(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis
    ) -> list[FloatArray]:
        return self.residuals(hypotheses, np.zeros(1, dtype=np.int64))

    def simulate_recording(
        self, hypotheses: Sequence[Hypothesis], corrected_at: Hypothesis, recording: int
    ) -> list[FloatArray]:
        owner = np.repeat(self.recordings, self.lengths)
        return [r[owner == recording] for r in self.simulate(hypotheses, corrected_at)]

    def fit(
        self,
        hypothesis: Hypothesis,
        residual: FloatArray,
        iterations: int,
        corrected_at: Hypothesis,
    ) -> tuple[Hypothesis, FloatArray, FloatArray]:
        weights = 1.0 / np.sqrt(np.mean(residual**2, axis=0) + FLOOR**2)
        (fitted,) = fit(
            self, [hypothesis], weights, np.zeros(1, dtype=np.int64), iterations=iterations
        )
        return fitted.hypothesis, fitted.residual, fitted.jacobian

    def linearize(self, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray) -> View:
        count = len(self.measured)
        bins = Bins(np.arange(count), np.ones(count, dtype=np.int64), tuple(self.lengths))
        sensitivities = CandidateSensitivities([
            _sensitivity(t, response)
            for t, response in self.responses.items()
            if t not in hypothesis.terms
        ])  # fmt: skip
        own = self.change(hypothesis)
        linear: Any = SimpleNamespace(
            simulator=SimpleNamespace(threads=1),
            trajectory=SimpleNamespace(position=np.zeros((1, 1, 1)), steps=1),
            bins=bins,
            differences=lambda hypotheses: [self.change(h) - own for h in hypotheses],
        )
        seen = ResidualView(residual, jacobian, self.floor, self.lengths)
        return View(linear, bins, seen, sensitivities)

    def view_by_simulation(
        self, hypothesis: Hypothesis, residual: FloatArray, jacobian: FloatArray, closest: int
    ) -> View:
        return self.linearize(hypothesis, residual, jacobian)

    def size(self, hypothesis: Hypothesis) -> Size:
        return Size(len(hypothesis.terms), hypothesis.free_count)

    def special_cases(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        out = []
        for term in hypothesis.terms:
            own = hypothesis.theta[hypothesis.slice_of(term)].tolist()
            values = dict(zip((p.name for p in term.parameters), own, strict=True))
            for effect, special in term.law.special_cases(values).items():
                new = Term(effect, term.joint)
                if new in self.responses and new not in hypothesis.terms:
                    start = np.array([special[p.name] for p in new.parameters])
                    out.append(hypothesis.without(term).with_term(new, start))
        return out

    def rewrites(self, hypothesis: Hypothesis) -> list[Hypothesis]:
        return []

    def sensor_effects(self, hypothesis: Hypothesis, mean_square: FloatArray) -> list[Hypothesis]:
        return []

    def starts(
        self, hypothesis: Hypothesis, unexplained: NDArray[np.bool_]
    ) -> list[tuple[Term, Hypothesis]]:
        return []

    def within_totals(self, hypothesis: Hypothesis) -> Hypothesis:
        return hypothesis

    def refusals(self, hypothesis: Hypothesis) -> Mapping[Term, str]:
        return self.refused(hypothesis)

    def other_friction_constraint(self, hypothesis: Hypothesis) -> Iterator[Physics]:
        return iter(())

    def other_settings(self, hypothesis: Hypothesis, *, is_explained: bool) -> Iterator[Physics]:
        return iter(())


def _sensitivity(term: Term, response: FloatArray) -> Sensitivity:
    start = np.array([p.starts[0] for p in term.parameters])
    amplitudes = term.amplitude_indices(start)
    return Sensitivity(term, start, amplitudes, (response * start)[..., amplitudes])


EFFECTS = (
    "viscous_friction", "coulomb_friction", "armature", "encoder_scale", "velocity_feedforward",
    "command_delay", "torque_constant", "quadratic_drag",
)  # fmt: skip
"""Effects of one parameter at each joint."""


def drawn_physics(
    seed: int,
    *,
    joints: int = 2,
    recordings: int = 3,
    samples: int = 300,
    truth: Mapping[Term, float] | None = None,
    disturbance: float = 0.0,
    alike: Mapping[Term, Term] | None = None,
    noise: float = 1.0,
) -> LinearPhysics:
    """A drawn problem.

    Args:
        seed: of all that is drawn.
        joints, recordings, samples: number of joints, of recordings, and of samples of each.
        truth: effect -> its parameter, in multiples of its reference; nothing by default.
        disturbance: RMS of a slow disturbance that no effect explains, in noise floors.
        alike: candidate -> candidate with the same change of all signals.
        noise: RMS noise in noise floors.
    """
    rng = np.random.default_rng(seed)
    terms = [Term(effect, j) for j in range(joints) for effect in EFFECTS]
    terms.append(Term("sensor_delay", -1))
    shape = recordings * samples, joints
    responses = {t: _drawn_motion(rng, t, recordings, samples, joints) for t in terms}
    for copy, original in (alike or {}).items():
        responses[copy] = responses[original]
    measured = noise * FLOOR * rng.standard_normal(shape)
    measured += (
        disturbance
        * FLOOR
        * np.concatenate([_smooth(rng, samples, joints) for _ in range(recordings)])
    )
    for term, value in (truth or {}).items():
        measured += responses[term][..., 0] * value
    names = [f"joint{j}" for j in range(joints)]
    return LinearPhysics(
        names, measured, responses, [samples] * recordings, list(range(recordings))
    )


def _drawn_motion(
    rng: np.random.Generator, term: Term, recordings: int, samples: int, joints: int
) -> FloatArray:
    """(samples, joints, 1) change of all signals: large at the own joint, less at the others."""
    size = np.full(joints, 0.2)
    size[slice(None) if term.joint < 0 else term.joint] = 1.0
    start = term.parameters[0].starts[0]
    motion = np.concatenate([_smooth(rng, samples, 1) for _ in range(recordings)])
    return (0.2 / start * motion * size)[..., None]


def _smooth(rng: np.random.Generator, samples: int, columns: int) -> FloatArray:
    """(samples, columns) sums of slow waves with RMS one."""
    time = np.linspace(0.0, 1.0, samples)[:, None, None]
    cycles = rng.uniform(1.0, 12.0, (columns, 6))
    phase = rng.uniform(0.0, 2.0 * np.pi, (columns, 6))
    waves = np.sin(2.0 * np.pi * cycles * time + phase).sum(axis=2) / np.sqrt(3.0)
    return np.asarray(waves)


def permuted(physics: LinearPhysics, order: Sequence[int]) -> LinearPhysics:
    """The same problem with the joints in another order."""
    new = {old: k for k, old in enumerate(order)}
    return replace(
        physics,
        joints=[physics.joints[j] for j in order],
        measured=physics.measured[:, list(order)],
        responses={
            Term(t.effect, new.get(t.joint, -1)): r[:, list(order)]
            for t, r in reversed(physics.responses.items())
        },
    )
