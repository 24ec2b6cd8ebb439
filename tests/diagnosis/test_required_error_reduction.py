"""How much of the prediction error an effect must remove to be accepted."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.diagnosis.verdict import own_mismatch, reduces_error_enough
from pytest_twin.diagnosis.verdict_settings import VERDICT

FLOOR = np.array([2e-4, 5e-4])


def _is_accepted(before: float, after: float, whole: float, signal: int = 1) -> bool:
    """Whether an effect with these RMS errors at one of two signals is accepted.

    The other signal is at its noise floor.

    Args:
        before, after: error without and with the effect, in noise floors.
        whole: error of the nominal model, in noise floors.
        signal: index of the signal.
    """
    each = np.full((3, 2), 1.0)
    each[:, signal] = before, after, whole
    squares = (each * FLOOR) ** 2
    return reduces_error_enough(FLOOR, *squares, VERDICT.identifiable)


def test_an_effect_that_removes_less_than_the_smallest_identifiable_error_is_rejected() -> None:
    # The effect removes 0.79 squared floors, 42 % of the squared residual above the floor.
    # The smallest identifiable error, 1.5 floors, is 1.25 squared floors above it.
    assert not _is_accepted(1.7, 1.45, 1.7)
    assert not _is_accepted(1.7, 1.45, 60.0)


@pytest.mark.parametrize("after", [1.0, 2.0, 3.0])
def test_near_the_noise_floor_an_effect_must_remove_the_smallest_identifiable_error(
    after: float,
) -> None:
    influence = VERDICT.identifiable**2 - 1.0
    whole = np.hypot(after, 1.0)
    assert _is_accepted(float(np.sqrt(after**2 + 1.01 * influence)), after, whole)
    assert not _is_accepted(float(np.sqrt(after**2 + 0.99 * influence)), after, whole)


def test_an_effect_must_remove_a_tenth_of_a_large_remaining_squared_error() -> None:
    assert _is_accepted(20.0, 18.9, 20.0)
    assert not _is_accepted(20.0, 19.1, 20.0)


def test_an_inexact_effect_may_leave_the_same_share_of_error_elsewhere_as_at_its_joint() -> None:
    """An error of the wrist moves the shoulder too. Once the residual of the wrist is at the noise
    floor, the residual of the shoulder must have its own cause.
    """
    whole, at_wrist = np.array([130.0, 240.0]), np.array([False, True])

    def own(wrist: float) -> float:
        left = np.array([4.5, wrist]) ** 2 * FLOOR**2
        found = own_mismatch(FLOOR, whole**2 * FLOOR**2, left, at_wrist)
        assert found[1] == pytest.approx((240.0 * FLOOR[1]) ** 2)
        return float(np.sqrt(found[0]) / FLOOR[0])

    assert _is_accepted(4.5, 1.0, own(0.5), 0)
    assert not _is_accepted(4.5, 1.0, 130.0, 0)
    # The wrist keeps 6 % of its RMS error, so it may cause all of the shoulder's error.
    assert own(0.06 * 240.0) == pytest.approx(130.0)
    # Without an accepted effect, the whole nominal error counts.
    none = own_mismatch(FLOOR, whole**2, np.ones(2), np.array([False, False]))
    assert none == pytest.approx(whole**2)
