"""The comparison on rows that are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pytest_twin.changes.background import Rows
from pytest_twin.changes.comparison import _explained_share, compare
from pytest_twin.effects.friction import PositionDependentFriction, ViscousFriction
from pytest_twin.estimation.hypothesis import Term
from pytest_twin.identification.effort.law_columns import Shape


@dataclass(frozen=True)
class DrawnRows:
    """Rows of one joint with independent columns."""

    recording: None
    time: np.ndarray
    effort: np.ndarray
    columns: tuple[np.ndarray, ...]
    matrix: tuple[np.ndarray, ...]


def drawn(seed: int, amplitudes: tuple[float, ...], samples: int = 200) -> DrawnRows:
    random = np.random.default_rng(seed)
    matrix = random.standard_normal((samples, len(amplitudes)))
    scattered = np.array(amplitudes) + 0.01 * random.standard_normal(len(amplitudes))
    effort = matrix @ scattered + 0.1 * random.standard_normal(samples)
    return DrawnRows(
        None, np.arange(samples) * 0.1, effort[:, None], (np.arange(len(amplitudes)),), (matrix,)
    )


def test_a_law_changes_once_although_it_leaves_a_rest_in_another_of_its_shapes() -> None:
    ripple, damping = Term(PositionDependentFriction.id, 0), Term(ViscousFriction.id, 0)
    shapes = [
        Shape(ripple, np.array([0.0]), {0: 0}), Shape(ripple, np.array([0.0]), {0: 1}),
        Shape(damping, np.array([0.0]), {0: 2}),
    ]  # fmt: skip
    earlier = [drawn(k, (0.3, 0.3, 0.3)) for k in range(5)]
    new = [drawn(5 + k, (1.3, 0.7, 0.3)) for k in range(3)]
    rows = Rows.of([*earlier, *new], np.ones(1), 3)
    found = compare(rows, [[k] for k in range(5)], [[5], [6], [7]], shapes, 0.05)
    assert found.is_changed
    assert len(found.changes) <= 1


@pytest.mark.parametrize(("own", "share"), [((6.0, 0.1), 0.99), ((6.0, 12.0), 0.33)])
def test_what_is_new_where_a_change_hardly_acts_is_no_evidence_about_its_name(
    own: tuple[float, float], share: float
) -> None:
    left, added = np.array([0.0, 12.0]), np.array([6.0, 12.0])
    assert _explained_share(np.array(own), left, added) == pytest.approx(share, abs=0.01)
