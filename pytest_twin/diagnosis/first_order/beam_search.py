"""Beam search for the sets of effects that explain a residual, to first order.

Forces add, and so do first-order sensitivities. A set of effects is therefore a linear
least-squares problem, in which the parameters of present effects are estimated too. All problems
share inner products that are computed once (normal equations), so that many sets can be compared.
The best sets of each size get one more term. Then each term is exchanged for one or two others.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.first_order.sensitivities import Sensitivity
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.estimation.deadline import check_deadline
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.estimation.score import effective_samples, log_likelihood
from pytest_twin.realization.executor import Forks

_RIDGE = 1e-8
"""Fraction of the normalized diagonal that is added to it, so that dependent effects can be
solved."""
_MAX_EXCHANGES = 4
"""Largest number of consecutive exchanges of terms."""


def candidates(problem: Problem) -> list[Term]:
    """Every candidate effect at every joint where it can act."""
    servo, mask = problem.simulator.layout.servo, problem.mask
    found = []
    for effect in catalogue().values():
        if not effect.candidate or (mask is not None and not mask.allows(effect.id)):
            continue
        if effect.needs_effort_sensor and problem.effort_floor is None:
            continue
        if effect.family == "contact" and not problem.simulator.models.contact.has(effect.id):
            continue
        if effect.scope == "robot":
            found.append(Term(effect.id, -1))
            continue
        for j, joint in enumerate(problem.joints):
            if mask is not None and not mask.allows(effect.id, joint):
                continue
            if effect.family in ("actuation", "timing") and servo[j] not in effect.modes:
                continue
            if effect.periodic and problem.simulator.layout.slides[j]:
                continue
            found.append(Term(effect.id, j))
    return found


def given_terms(problem: Problem) -> list[Term]:
    """Effects that every model of the search has, at each joint whose drive can have them."""
    servo, mask = problem.simulator.layout.servo, problem.mask
    if mask is None:
        return []
    return [
        term
        for term in candidates(problem)
        if term.effect in mask.given and term.joint >= 0
        and servo[term.joint] in term.law.basic_modes
    ]  # fmt: skip


@dataclass(slots=True)
class ResidualView:
    """Residual and Jacobian of the present hypothesis, averaged over bins.

    Attributes:
        residual: (bins, signals) residual of the hypothesis.
        jacobian: (bins, signals, parameters) Jacobian of its prediction.
        floor: (signals,) noise floor, in the unit of each signal.
        lengths: number of bins of each segment.
    """

    residual: FloatArray
    jacobian: FloatArray
    floor: FloatArray
    lengths: Sequence[int]

    @property
    def mean_square(self) -> FloatArray:
        """(signals,) mean square of the residual."""
        mean_square: FloatArray = np.mean(self.residual**2, axis=0)
        return mean_square

    def effective_of_best(self, residuals: Sequence[FloatArray]) -> FloatArray:
        """(signals,) effective samples of the smallest of several (bins, signals) residuals."""

        def misfit(residual: FloatArray) -> float:
            mean_square = np.nan_to_num(np.mean(residual**2, axis=0), nan=np.inf)
            return float(np.log(np.maximum(mean_square, self.floor**2)).sum())

        return effective_samples(np.nan_to_num(min(residuals, key=misfit)), self.lengths)

    def penalized_likelihood(
        self, residual: FloatArray, effective: FloatArray, parameters: int
    ) -> float:
        """Log-likelihood of a (bins, signals) residual minus the penalty of its parameters."""
        return (
            log_likelihood(residual, self.floor, effective)
            - parameter_penalty(effective) * parameters
        )


@dataclass(slots=True)
class Structure:
    """A set of terms that explains a residual to first order.

    Attributes:
        starts: term -> parameters in multiples of their scales, in the order of addition.
        residual: (bins, signals) residual with these terms.
        evidence: penalized log-likelihood ratio to the structure that it was compared with.
        chosen: indices of the sensitivities of its terms.
    """

    starts: dict[Term, FloatArray]
    residual: FloatArray
    evidence: float = 0.0
    chosen: tuple[int, ...] = ()

    @property
    def parameters(self) -> int:
        """Number of parameters that a fit estimates."""
        return sum(int(t.is_estimated(start).sum()) for t, start in self.starts.items())


def parameter_penalty(effective: FloatArray) -> float:
    """Penalty of the log-likelihood for each parameter (BIC: Schwarz 1978).

    Args:
        effective: (signals,) effective samples.
    """
    return float(0.5 * np.log(max(float(effective.mean()), 2.0)))


def effect_penalty(candidates: int) -> float:
    """Penalty of the log-likelihood for each effect, chosen from a number of ``candidates``.

    Source: extended BIC (Chen, Chen, Biometrika 95, 2008).
    """
    return float(np.log(max(candidates, 1)))


@dataclass(slots=True)
class _Group:
    """Sensitivities with the same number of amplitudes, for batched algebra.

    Attributes:
        which: (sensitivities,) their indices.
        columns: (sensitivities, amplitudes) indices of their columns.
        own: (signals, sensitivities, amplitudes, amplitudes) inner products among their columns.
    """

    which: NDArray[np.int64]
    columns: NDArray[np.int64]
    own: FloatArray


class CandidateSensitivities:
    """Sensitivities of all candidates as columns of a matrix, with their inner products.

    Attributes:
        at: slice of the columns of each sensitivity.
        free: number of parameters that a fit of each estimates.
        lower, upper: (columns,) bounds of the amplitudes.
    """

    def __init__(self, responses: Sequence[Sensitivity]) -> None:
        self.responses = list(responses)
        self.at: list[slice] = []
        self.free = [int(r.term.is_estimated(r.start).sum()) for r in self.responses]
        parts, ends, count = [], [], 0
        for r in self.responses:
            self.at.append(slice(count, count + len(r.amplitude_indices)))
            count += len(r.amplitude_indices)
            parts.append(np.moveaxis(r.change, 0, -1))  # (signals, amplitudes, bins)
            for s in r.amplitude_indices:
                parameter = r.term.parameters[s]
                ends.append(sorted([parameter.lower / r.start[s], parameter.upper / r.start[s]]))
        self.lower, self.upper = np.reshape(ends, (-1, 2)).T
        joined = np.concatenate(parts, axis=1) if parts else np.zeros((1, 0, 1))
        self.columns = np.ascontiguousarray(joined, dtype=np.float32)
        self._products: dict[int, FloatArray] = {}
        self.penalty_per_effect = effect_penalty(len({r.term for r in self.responses}))
        self.groups = [
            self._group(m) for m in sorted({len(r.amplitude_indices) for r in self.responses})
        ]

    @property
    def elastic_transmissions(self) -> frozenset[Term]:
        """Candidates that only a simulation can compare with others.

        The force of an elastic transmission is evaluated along the measured motion of the link. It
        contains what is to be explained, and so seems to explain nearly everything.
        """
        return frozenset(r.term for r in self.responses if r.term.law.is_elastic_transmission)

    def _group(self, count: int) -> _Group:
        which = np.array(
            [i for i, r in enumerate(self.responses) if len(r.amplitude_indices) == count],
            dtype=np.int64,
        )
        columns = np.array([np.arange(self.at[i].start, self.at[i].stop) for i in which])
        block = self.columns[:, columns].astype(np.float64)
        return _Group(which, columns, np.matmul(block, block.swapaxes(-1, -2)))

    def columns_of(self, chosen: Sequence[int]) -> list[int]:
        """Indices of the columns of several sensitivities, in their order."""
        return [c for i in chosen for c in range(self.at[i].start, self.at[i].stop)]

    def inner_products(self, other: FloatArray) -> FloatArray:
        """(signals, columns, k) inner products with other columns, (bins, signals, k)."""
        moved = np.ascontiguousarray(np.moveaxis(other, 0, 1), dtype=np.float32)
        if not self.responses:
            return np.zeros((len(moved), 0, moved.shape[2]))
        return np.asarray(np.matmul(self.columns, moved), dtype=np.float64)

    def products(self, response: int) -> FloatArray:
        """(signals, columns, amplitudes) inner products of all columns with those of a response."""
        self.compute_products([response])
        return self._products[response]

    def compute_products(self, responses: Iterable[int]) -> None:
        """Compute and keep inner products with the columns of several responses.

        Together they take one fifth of the time that they take one by one.
        """
        new = [i for i in dict.fromkeys(responses) if i not in self._products]
        if not new:
            return
        of_new = self.columns[:, self.columns_of(new)].swapaxes(-1, -2)
        found = np.matmul(self.columns, of_new).astype(np.float64)
        at = 0
        for i in new:
            count = len(self.responses[i].amplitude_indices)
            self._products[i] = found[:, :, at : at + count]
            at += count


class NormalEquations:
    """Normal equations of one residual with all candidates, from which structures are solved.

    Args:
        view: residual and Jacobian of the present hypothesis.
    """

    def __init__(self, view: ResidualView, candidate_sensitivities: CandidateSensitivities) -> None:
        self.view = view
        self.candidate_sensitivities = candidate_sensitivities
        self.bins = len(view.residual)
        jacobian = np.moveaxis(view.jacobian, 1, 0)  # (signals, bins, parameters)
        self.own = jacobian.swapaxes(-1, -2) @ jacobian
        self.own_residual = np.einsum("sbp,bs->sp", jacobian, view.residual)
        self.squared = np.einsum("bs,bs->s", view.residual, view.residual)
        self.with_own = candidate_sensitivities.inner_products(view.jacobian)
        self.with_residual = candidate_sensitivities.inner_products(view.residual[:, :, None])[
            :, :, 0
        ]

    @property
    def base(self) -> Structure:
        """The structure without new terms: only the present parameters are refitted."""
        return self.structure(())

    def _normal(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Normal matrix (signals, p, p) and right-hand side (signals, p) of a structure.

        The p unknowns are the present parameters, then the amplitudes of the chosen responses.
        """
        candidate_sensitivities = self.candidate_sensitivities
        columns = candidate_sensitivities.columns_of(chosen)
        p = self.own.shape[1]
        total = p + len(columns)
        normal = np.empty((len(self.squared), total, total))
        normal[:, :p, :p] = self.own
        side = self.with_own[:, columns]
        normal[:, p:, :p] = side
        normal[:, :p, p:] = side.swapaxes(-1, -2)
        at = p
        for i in chosen:
            block = candidate_sensitivities.products(i)[:, columns]
            normal[:, p:, at : at + block.shape[2]] = block
            at += block.shape[2]
        right = np.concatenate([self.own_residual, self.with_residual[:, columns]], axis=1)
        return normal, right

    def structure(self, chosen: tuple[int, ...]) -> Structure:
        """The structure with the ``chosen`` responses; all amplitudes are fitted within bounds."""
        normal, right = self._normal(chosen)
        p = self.own.shape[1]
        candidate_sensitivities = self.candidate_sensitivities
        columns = candidate_sensitivities.columns_of(chosen)
        lower = np.concatenate([np.full(p, -np.inf), candidate_sensitivities.lower[columns]])
        upper = np.concatenate([np.full(p, np.inf), candidate_sensitivities.upper[columns]])
        x = self._solve(normal[:, None], right[:, None], lower[None], upper[None])[0][0]
        residual = self.view.residual - self.view.jacobian @ x[:p]
        starts: dict[Term, FloatArray] = {}
        at = p
        for i in chosen:
            r = candidate_sensitivities.responses[i]
            amplitude = x[at : at + len(r.amplitude_indices)]
            at += len(r.amplitude_indices)
            residual = residual - r.change @ amplitude
            start = r.start.copy()
            start[list(r.amplitude_indices)] *= amplitude
            starts[r.term] = start
        return Structure(starts, residual, 0.0, chosen)

    def _solve(
        self, normal: FloatArray, right: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Amplitudes (k, p) and mean squared residuals (k, signals) of k problems.

        Args:
            normal: (signals, k, p, p) normal matrices.
            right: (signals, k, p) right-hand sides.
            lower, upper: (k, p) bounds. Amplitudes beyond a bound are set to it, and the others are
                solved again.
        """
        count, p = right.shape[1:]
        mean_square = np.repeat((self.squared / self.bins)[None], count, axis=0)
        x = np.zeros((count, p))
        if not p:
            return x, mean_square
        eye = np.eye(p)
        for _ in range(3):
            # Solve again with weights from the residual, so that explained errors do not dominate.
            weight = 1.0 / (mean_square + self.view.floor**2)
            a = np.einsum("ks,skpq->kpq", weight, normal)
            b = np.einsum("ks,skp->kp", weight, right)
            size = np.sqrt(np.maximum(np.einsum("kpp->kp", a), 1e-300))
            scaled = a / (size[:, :, None] * size[:, None, :]) + _RIDGE * eye
            x = np.linalg.solve(scaled, (b / size)[..., None])[..., 0] / size
            held = np.clip(x, lower, upper)
            fixed = held != x
            if fixed.any():
                # Amplitudes at a bound are fixed, and the others are solved again.
                keep = ~fixed
                kept = scaled * (keep[:, :, None] & keep[:, None, :]) + eye * fixed[:, :, None]
                rest = b / size - np.einsum("kpq,kq->kp", scaled, np.where(fixed, held * size, 0.0))
                again = np.linalg.solve(kept, np.where(keep, rest, 0.0)[..., None])[..., 0] / size
                x = np.clip(np.where(fixed, held, again), lower, upper)
            taken = (normal @ x[None, :, :, None])[..., 0]
            explained = np.einsum("kp,skp->ks", x, 2.0 * right - taken)
            mean_square = np.maximum(self.squared[None] - explained, 0.0) / self.bins
        return x, mean_square

    def children(self, parent: Structure, excluded: Collection[Term] = ()) -> list[tuple[int, ...]]:
        """Structures with one more term, the best first, at most one for each term.

        All are ranked with the effective samples of the best child's residual. The parent's would
        be too few, because an unexplained disturbance correlates all samples.

        Args:
            parent: the structure that gets one more term.
            excluded: terms that are not added.
        """
        candidate_sensitivities, floor = self.candidate_sensitivities, self.view.floor
        base, base_right = self._normal(parent.chosen)
        p = base.shape[1]
        cross_products = [
            self.with_own,
            *(candidate_sensitivities.products(i) for i in parent.chosen),
        ]
        with_base = np.concatenate(cross_products, axis=2)
        misfit = np.full((len(candidate_sensitivities.responses), len(self.squared)), np.inf)
        excluded = {*parent.starts, *excluded}
        new = np.array(
            [r.term not in excluded for r in candidate_sensitivities.responses], dtype=bool
        )
        for group in candidate_sensitivities.groups:
            added = new[group.which]
            if not added.any():
                continue
            columns, which = group.columns[added], group.which[added]
            k, m = columns.shape
            normal = np.empty((len(self.squared), k, p + m, p + m))
            normal[:, :, :p, :p] = base[:, None]
            side = with_base[:, columns]
            normal[:, :, p:, :p] = side
            normal[:, :, :p, p:] = side.swapaxes(-1, -2)
            normal[:, :, p:, p:] = group.own[:, added]
            right = np.concatenate(
                [np.repeat(base_right[:, None], k, axis=1), self.with_residual[:, columns]], axis=2
            )
            lower = np.concatenate(
                [np.full((k, p), -np.inf), candidate_sensitivities.lower[columns]], axis=1
            )
            upper = np.concatenate(
                [np.full((k, p), np.inf), candidate_sensitivities.upper[columns]], axis=1
            )
            _, mean_square = self._solve(normal, right, lower, upper)
            misfit[which] = np.log(np.maximum(mean_square, floor**2))
        possible = np.flatnonzero(np.isfinite(misfit).all(axis=1))
        if not len(possible):
            return []
        closest = int(possible[np.argmin(misfit[possible].sum(axis=1))])
        residual = self.structure((*parent.chosen, closest)).residual
        effective = self.view.effective_of_best([parent.residual, residual])
        cost = parameter_penalty(effective)
        best: dict[Term, tuple[float, int]] = {}
        for i in map(int, possible):
            term = candidate_sensitivities.responses[i].term
            gain = -0.5 * float(misfit[i] @ effective) - cost * candidate_sensitivities.free[i]
            if term not in best or gain > best[term][0]:
                best[term] = gain, i
        ranked = sorted(best.values(), key=lambda x: -x[0])
        return [(*parent.chosen, i) for _, i in ranked]

    def rank(self, parent: Structure, children: list[Structure]) -> list[Structure]:
        """Children, the largest evidence over ``parent`` first; sets their ``evidence``.

        The evidence uses the effective samples of the best child.
        """
        effective = self.view.effective_of_best([c.residual for c in children])

        def penalized(s: Structure) -> float:
            penalty = self.candidate_sensitivities.penalty_per_effect * len(s.starts)
            return self.view.penalized_likelihood(s.residual, effective, s.parameters) - penalty

        of_parent = penalized(parent)
        for c in children:
            c.evidence = penalized(c) - of_parent
        return sorted(children, key=lambda c: -c.evidence)


@dataclass(slots=True)
class BeamSearch:
    """Beam search over structures.

    Attributes:
        width: number of structures that are kept at each size.
        most: largest number of terms.
        earns: evidence that a larger or an exchanged structure must gain.
        is_accepted: (mean squares before, after), both (signals,) -> whether one more effect is
            accepted.
        cores: number of processes.
        excluded: terms that are not added.
    """

    width: int
    most: int
    earns: float
    is_accepted: Callable[[FloatArray, FloatArray], bool]
    cores: int = 1
    excluded: Collection[Term] = ()
    _seen: dict[frozenset[int], Structure] = field(default_factory=dict)
    _children: dict[tuple[int, ...], list[tuple[int, ...]]] = field(default_factory=dict)

    def levels(self, equations: NormalEquations) -> list[list[Structure]]:
        """Structures with one, two, ... terms that explain a residual, the best of a size first."""
        level = [equations.base]
        found: list[list[Structure]] = []
        for _ in range(self.most):
            grown = self._grow(equations, level, 2 * self.width)
            if not grown:
                break
            children = equations.rank(level[0], grown)
            before = np.mean(level[0].residual ** 2, axis=0)
            # One accepted structure is enough to continue with all: a pair can be accepted although
            # neither of its effects is.
            passing = [
                c for c in children
                if c.evidence >= self.earns
                and self.is_accepted(before, np.mean(c.residual**2, axis=0))
            ]  # fmt: skip
            if not passing:
                break
            level = [passing[0], *(c for c in children[: self.width] if c is not passing[0])]
            found.append(level)
        if not found:
            return []
        for size in found:
            self._exchange_terms(equations, size[0])
        sizes: dict[int, list[Structure]] = {}
        for structure in self._seen.values():
            sizes.setdefault(len(structure.chosen), []).append(structure)
        return [equations.rank(equations.base, sizes[n])[: self.width] for n in sorted(sizes)]

    def _grow(
        self, equations: NormalEquations, level: Sequence[Structure], count: int
    ) -> list[Structure]:
        """Structures of ``level`` with one more term; ``count`` for each of them.

        Raises:
            OutOfTime: the time of the search is over.
        """
        check_deadline()
        parents = [s for s in level if len(s.chosen) < self.most]
        equations.candidate_sensitivities.compute_products(i for s in parents for i in s.chosen)
        unknown = [s for s in parents if s.chosen not in self._children]
        grown = Forks(self.cores).map(partial(equations.children, excluded=self.excluded), unknown)
        self._children |= zip([s.chosen for s in unknown], grown, strict=True)
        wanted = {frozenset(c): c for s in parents for c in self._children[s.chosen][:count]}
        new = {key: chosen for key, chosen in wanted.items() if key not in self._seen}
        equations.candidate_sensitivities.compute_products(
            i for chosen in new.values() for i in chosen
        )
        self._seen |= {key: equations.structure(chosen) for key, chosen in new.items()}
        return [self._seen[key] for key in wanted]

    def _exchange_terms(self, equations: NormalEquations, best: Structure) -> None:
        """Exchange terms of a structure for one or two others, as long as the evidence improves."""
        for _ in range(_MAX_EXCHANGES):
            pool: list[Structure] = []
            for i in best.chosen:
                without = equations.structure(tuple(c for c in best.chosen if c != i))
                ones = self._grow(equations, [without], self.width)
                pool += ones
                if len(best.chosen) < self.most:
                    pool += self._grow(equations, ones, 3)
            pool = [s for s in pool if set(s.chosen) != set(best.chosen)]
            if not pool:
                break
            top = equations.rank(best, pool)[0]
            if top.evidence < self.earns:
                break
            best = top
