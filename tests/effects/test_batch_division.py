"""Division of simulation rows among batches and processor cores."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
from hypothesis import given
from hypothesis.extra import numpy as arrays

from pytest_twin.effects.batch_division import divide_rows, is_worth_forking

_counts = st.integers(1, 60)


@given(st.data(), _counts, st.integers(0, 5), st.integers(1, 7), st.integers(1, 5))
def test_each_row_is_in_exactly_one_part_with_rows_of_similar_length_and_kind(
    data: st.DataObject, count: int, laws: int, joints: int, cores: int
) -> None:
    steps = data.draw(arrays.arrays(np.int64, count, elements=st.integers(1, 9000)))
    acts = data.draw(arrays.arrays(np.bool_, (count, laws)))
    found = divide_rows(steps, acts, joints, cores)
    assert sorted(np.concatenate([p.rows for p in found])) == list(range(count))
    for p in found:
        assert steps[p.rows].max() <= 1.1 * steps[p.rows].min() + 8
        assert len(set(acts[p.rows].any(axis=1).tolist())) == 1
    assert [p.seconds for p in found] == sorted((p.seconds for p in found), reverse=True)


def test_rows_with_the_same_effects_go_to_the_same_core() -> None:
    steps = np.full(80, 6000)
    acts = np.zeros((80, 2), dtype=bool)
    acts[::2, 0] = acts[1::2, 1] = True
    one, other = divide_rows(steps, acts, 6, 2)
    assert {len(set((rows % 2).tolist())) for rows in (one.rows, other.rows)} == {1}
    assert is_worth_forking([one, other])


def test_a_few_rows_with_effects_are_not_divided_among_cores() -> None:
    """The Python code between engine steps would run once per core and save almost no time."""
    assert len(divide_rows(np.full(2, 300), np.ones((2, 1), dtype=bool), 1, 2)) == 1


def test_rows_without_effects_are_divided_evenly_among_cores() -> None:
    found = divide_rows(np.full(100, 5000), np.zeros((100, 0), dtype=bool), 6, 4)
    assert [len(p.rows) for p in found] == [25] * 4


def test_no_batch_exceeds_384_rows() -> None:
    found = divide_rows(np.full(1000, 50), np.zeros((1000, 0), dtype=bool), 6, 1)
    assert max(len(p.rows) for p in found) == 384


def test_rows_with_the_same_effects_share_a_batch_when_one_batch_is_too_small() -> None:
    acts = np.zeros((1152, 3), dtype=bool)
    acts[np.arange(1152), np.arange(1152) % 3] = True
    found = divide_rows(np.full(1152, 250), acts, 2, 1)
    assert sorted(np.unique(p.rows % 3).tolist() for p in found) == [[0], [1], [2]]
