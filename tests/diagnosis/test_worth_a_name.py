"""By how much an error has to fall for a name to have made it fall."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.verdict import own_mismatch, reduces_error_enough
from pytest_twin.diagnosis.verdict_settings import VERDICT

FLOOR = np.array([2e-4, 5e-4])


def _worth(before: float, after: float, whole: float, signal: int = 1) -> bool:
    """Of one of two signals, in floors; the other is at its floor throughout."""
    each = np.full((3, 2), 1.0)
    each[:, signal] = before, after, whole
    return reduces_error_enough(FLOOR, *(each * FLOOR) ** 2)


def test_what_would_not_stand_out_alone_is_no_names_merit() -> None:
    # Three tenths of what stands above the floor, and yet far less than any finding has to take.
    assert not _worth(1.7, 1.45, 1.7)
    assert not _worth(1.7, 1.45, 60.0)


@pytest.mark.parametrize("after", [1.0, 2.0, 3.0])
def test_the_bar_is_what_a_finding_has_to_stand_out_by(after: float) -> None:
    influence = VERDICT.stands_out**2 - 1.0
    whole = np.hypot(after, 1.0)
    assert _worth(float(np.sqrt(after**2 + 1.01 * influence)), after, whole)
    assert not _worth(float(np.sqrt(after**2 + 0.99 * influence)), after, whole)


def test_far_off_it_is_a_share_of_what_is_left() -> None:
    assert _worth(20.0, 18.9, 20.0)
    assert not _worth(20.0, 19.1, 20.0)


def test_what_a_law_may_have_left_elsewhere_is_no_more_than_what_it_leaves_where_it_acts() -> None:
    """A wrist that flails shakes the whole arm; once it is right to the noise, what is left of a
    shoulder is the shoulder's own.
    """
    whole, at_wrist = np.array([130.0, 240.0]), np.array([False, True])

    def own(wrist: float) -> float:
        left = np.array([4.5, wrist]) ** 2 * FLOOR**2
        found = own_mismatch(FLOOR, whole**2 * FLOOR**2, left, at_wrist)
        assert found[1] == pytest.approx((240.0 * FLOOR[1]) ** 2)
        return float(np.sqrt(found[0]) / FLOOR[0])

    assert _worth(4.5, 1.0, own(0.5), 0)
    assert not _worth(4.5, 1.0, 130.0, 0)
    # A twentieth of the wrist's amplitude is left: so it may be of the shoulder's.
    assert own(0.06 * 240.0) == pytest.approx(130.0)
    # Nothing is named yet: every law may be a little off.
    none = own_mismatch(FLOOR, whole**2, np.ones(2), np.array([False, False]))
    assert none == pytest.approx(whole**2)
