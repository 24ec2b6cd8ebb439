"""By how much an error has to fall for a name to have made it fall."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.verdict import STANDS_OUT, worth_a_name

FLOOR = np.array([2e-4, 5e-4])


def _worth(before: float, after: float, whole: float) -> bool:
    """Of the second of two signals, in floors; the first is at its floor throughout."""
    squares = [np.array([1.0, floors**2]) * FLOOR**2 for floors in (before, after, whole)]
    return worth_a_name(FLOOR, *squares)


def test_what_would_not_stand_out_alone_is_no_names_merit() -> None:
    # Three tenths of what stands above the floor, and yet far less than any finding has to take.
    assert not _worth(1.7, 1.45, 1.7)
    assert not _worth(1.7, 1.45, 60.0)


@pytest.mark.parametrize("after", [1.0, 2.0, 3.0])
def test_the_bar_is_what_a_finding_has_to_stand_out_by(after: float) -> None:
    stands = STANDS_OUT**2 - 1.0
    whole = np.hypot(after, 1.0)
    assert _worth(float(np.sqrt(after**2 + 1.01 * stands)), after, whole)
    assert not _worth(float(np.sqrt(after**2 + 0.99 * stands)), after, whole)


def test_far_off_it_is_a_share_of_what_is_left() -> None:
    assert _worth(20.0, 18.9, 20.0)
    assert not _worth(20.0, 19.1, 20.0)
