"""The effects of a search by stage, each stage tested on recordings that no fit has used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.verdict import JointError
from pytest_twin.diagnosis.verdict_settings import VERDICT
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.estimation.least_squares import FittedModel, fit
from pytest_twin.estimation.paired_test import compare_paired
from pytest_twin.identification.simulation.stage_effects import TOGETHER, StagePlan
from pytest_twin.identification.stages import HeldOut, Stage, StageName, judge_stage

_ITERATIONS = 3
"""Iterations of a fit without the effects of a stage, which starts at the fit with them."""
EXCLUDES: Mapping[StageName, str] = {
    "delay": "all other effects were free: damping and friction delay a motion, too",
    "encoder": "gains and dry friction were free: both leave an offset at rest, too",
    "gravity": "gains and friction were free: a soft drive sags as under a weight",
    "inertia": "gains and damping were free: they move the resonance, too",
    "friction": "gains and armature were free",
    "drive": "all other effects were free",
    TOGETHER: "all effects together",
}


@dataclass(frozen=True)
class StageTests:
    """The problem that was fitted, and the one that tests the fit.

    Attributes:
        plan: stages, and the effects of each.
        fitted: the fit of all effects, with its derivatives.
        problem: its problem.
        tested: problem whose held-out recordings test the stages.
        at_tested_joints: function that returns a hypothesis in the numbering of its joints.
    """

    plan: StagePlan
    fitted: FittedModel
    problem: Problem
    tested: Problem
    at_tested_joints: Callable[[Hypothesis], Hypothesis]

    def stages(self, errors: Mapping[str, JointError]) -> list[Stage]:
        """Return all stages in order; a stage without effects is not observable.

        Args:
            errors: joint -> error of the model with all effects.
        """
        return [*map(self._stage, self.plan.order), self.together(errors)]

    def without_rejected(self, stages: Sequence[Stage]) -> Hypothesis:
        """Return the hypothesis without the effects of rejected stages, the others fitted again."""
        rejected = {stage.name for stage in stages if stage.state == "rejected"} - {TOGETHER}
        terms = self.fitted.hypothesis.terms
        removed = [t for t in terms if self.plan.stage_of[t.effect] in rejected]
        return self._fitted_without(removed) if removed else self.fitted.hypothesis

    def _stage(self, name: StageName) -> Stage:
        hypothesis = self.fitted.hypothesis
        terms = [t for t in hypothesis.terms if self.plan.stage_of[t.effect] == name]
        if not terms:
            return Stage(
                name, "not_observable",
                "at no joint do effects of this stage predict recordings that they are not fitted "
                "to better than chance explains",
                (), None, EXCLUDES[name],
            )  # fmt: skip
        without = self._fitted_without(terms)
        held_out, tolerance = self._compare(without, hypothesis)
        stage = Stage(name, "accepted", "", self._names(terms), None, EXCLUDES[name])
        return judge_stage(stage, held_out, tolerance)

    def _fitted_without(self, terms: Sequence[Term]) -> Hypothesis:
        """Return the hypothesis without some effects, the others fitted again."""
        hypothesis = self.fitted.hypothesis
        rest, kept = hypothesis.without(*terms), hypothesis.parameters_without(*terms)
        if not rest.terms:
            return rest
        here = self.problem.at(hypothesis)
        (refitted,) = fit(
            here, [rest], here.weights(self.fitted.mean_square), here.fit,
            iterations=_ITERATIONS, slopes=False, jacobians=[self.fitted.jacobian[..., kept]],
        )  # fmt: skip
        return refitted.hypothesis

    def together(self, errors: Mapping[str, JointError]) -> Stage:
        """Return the stage of all effects: accepted only if nothing but noise remains."""
        hypothesis, excludes = self.fitted.hypothesis, EXCLUDES[TOGETHER]
        remaining = {joint: e for joint, e in errors.items() if not e.is_at_floor}
        if not hypothesis.terms and not remaining:
            why = "the model predicts the motion to the noise floor: there is nothing to fit"
            return Stage(TOGETHER, "not_observable", why, (), None, excludes)
        held_out, tolerance = self._compare(EMPTY, hypothesis)
        stage = Stage(TOGETHER, "accepted", "", self._names(hypothesis.terms), None, excludes)
        stage = judge_stage(stage, held_out, tolerance)
        if not remaining:
            return stage
        levels = ", ".join(f"{e.after / e.floor:.2g} at {j}" for j, e in remaining.items())
        return replace(
            stage,
            state="rejected" if stage.state == "rejected" else "reopened",
            why=f"{stage.why}; noise floors that remain: {levels}, where {VERDICT.at_floor:g} or "
            "less are noise. The model lacks something there; pytest-twin diagnose locates it",
        )

    def _compare(self, before: Hypothesis, after: Hypothesis) -> tuple[HeldOut, float]:
        """Return the errors of two hypotheses in noise floors, and the relative standard error."""
        old, new = (self._in_floors(self.at_tested_joints(h)) for h in (before, after))
        change = compare_paired(old, new, self.tested.lengths(self.tested.tested_segments))
        levels = [float(np.sqrt(np.mean(x**2))) for x in (old, new)]
        level_before, level_after = (x if np.isfinite(x) else 1e9 for x in levels)
        size = float(np.sum(old**2, axis=1).mean())
        error = 0.5 * change.standard_error / size if np.isfinite(size) and size else 0.0
        return HeldOut(level_before, level_after, "noise floors"), error

    def _in_floors(self, hypothesis: Hypothesis) -> FloatArray:
        """Return the (n, joints) held-out position errors of a hypothesis, in noise floors."""
        tested = self.tested
        (residual,) = tested.at(hypothesis).residuals([hypothesis], tested.tested_segments)
        return np.asarray(residual[:, : len(tested.joints)] / tested.floor)

    def _names(self, terms: Sequence[Term]) -> tuple[str, ...]:
        return tuple(f"{place_of(self.problem, t)}.{t.effect}" for t in terms)


def place_of(problem: Problem, term: Term) -> str:
    """Name of the joint that a term acts at, or ``robot``."""
    return "robot" if term.joint < 0 else problem.joints[term.joint]


def with_derivatives(problem: Problem, hypothesis: Hypothesis) -> FittedModel:
    """Compute the derivatives of a prediction, without changing the hypothesis."""
    problem = problem.at(hypothesis)
    (residual,) = problem.residuals([hypothesis], problem.fit)
    weights = problem.weights(np.mean(residual**2, axis=0))
    return fit(problem, [hypothesis], weights, problem.fit, iterations=0)[0]
