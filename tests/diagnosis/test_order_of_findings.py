"""Findings are ordered by how much the prediction changes without each of them."""

from __future__ import annotations

import numpy as np
import pytest
from test_elastic_transmissions import single_effect
from test_first_order import ELBOW, problem_of

from pytest_twin.diagnosis import findings
from pytest_twin.diagnosis.findings import (
    Explanation,
    Finding,
    differences_in_floors,
    order_by_whole_motions,
)
from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.estimation.hypothesis import EMPTY, Term

WEAK, DRAG = Term("torque_constant", 0), Term("viscous_friction", ELBOW)
SOON = 0.25


def test_under_effort_commands_only_the_beginning_of_a_window_ranks_findings() -> None:
    """Later the open-loop motion diverges after any change."""
    problem = problem_of("effort", {WEAK: {"relative_error": 0.3}})
    weak = single_effect(problem, WEAK, {"relative_error": 0.3})
    (height,) = differences_in_floors(problem, [weak, EMPTY])
    with_it, without = problem.predict([weak, EMPTY], problem.tested_segments)
    difference = [a.position - b.position for a, b in zip(with_it, without, strict=True)]
    beginning = [
        x[problem.simulator.segments[s].time < problem.simulator.segments[s].start + SOON]
        for x, s in zip(difference, problem.tested_segments, strict=True)
    ]
    expected, later = (np.sqrt(np.mean(np.concatenate(x) ** 2)) for x in (beginning, difference))
    assert height == pytest.approx(expected / problem.floor[0])
    assert later > 1.5 * expected


def test_under_position_commands_all_samples_rank_findings() -> None:
    problem = problem_of("position", {DRAG: {"coefficient": 0.3}})
    drag = single_effect(problem, DRAG, {"coefficient": 0.3})
    (height,) = differences_in_floors(problem, [drag, EMPTY])
    with_it, without = problem.predict([drag, EMPTY], problem.tested_segments)
    difference = np.concatenate(
        [a.position - b.position for a, b in zip(with_it, without, strict=True)]
    )
    level = np.sqrt(np.mean(difference**2, axis=0)) / problem.floor
    assert height == pytest.approx(level.max())


def finding_of(term: Term, joints: tuple[str, ...]) -> Finding:
    """A finding with an effect and a joint only."""
    joint = None if term.joint < 0 else joints[term.joint]
    return Finding(
        term.effect, joint, 1.0, {}, TimeAndRegime("", {}), 1.0, 0.0, (), "", (), term
    )  # fmt: skip


@pytest.mark.parametrize("diverges", [False, True], ids=["finite", "diverging"])
def test_findings_are_ordered_by_their_influence_on_whole_motions(
    diverges: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If a prediction diverges, the order in the windows is kept."""
    problem = problem_of("position", {DRAG: {"coefficient": 0.3}})
    both = single_effect(problem, DRAG, {"coefficient": 0.3})
    slight = single_effect(problem, WEAK, {"relative_error": 0.01})
    both = both.with_term_of(slight, WEAK)
    wrong = (finding_of(WEAK, problem.joints), finding_of(DRAG, problem.joints))
    explanation = Explanation(wrong, both)
    if diverges:
        monkeypatch.setattr(findings, "differences_in_floors", lambda *_: [np.inf, 1.0])
    found = order_by_whole_motions(explanation, problem).findings
    expected = ["torque_constant", "viscous_friction"]
    assert [f.effect for f in found] == (expected if diverges else expected[::-1])
    if not diverges:
        assert found[0].influence > 3.0 * found[1].influence > 0.0


def test_a_finding_that_changes_whole_motions_less_than_the_residual_keeps_its_rank() -> None:
    """Such motions have diverged, and their differences carry no information."""
    problem = problem_of("position", {})
    far = single_effect(problem, WEAK, {"relative_error": -0.3})
    slight = single_effect(problem, DRAG, {"coefficient": 0.001})
    both = far.with_term_of(slight, DRAG)
    order = (finding_of(DRAG, problem.joints), finding_of(WEAK, problem.joints))
    found = order_by_whole_motions(Explanation(order, both), problem).findings
    assert [f.effect for f in found] == ["viscous_friction", "torque_constant"]
    assert found[1].influence > found[0].influence
