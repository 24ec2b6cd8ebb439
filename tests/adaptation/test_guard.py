"""The guard of a residual model: the conditions that block the residual, and its force bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pytest_twin.adaptation.guard import Guard, Sample
from pytest_twin.adaptation_spec import JointRegion, ResidualSpec

SPEC = ResidualSpec(
    id="one",
    kind="function",
    joints={"a": JointRegion(0.5, (-1.0, 1.0), (-2.0, 2.0), 0.4)},
    period=0.01,
    max_age=0.02,
    hold_off=0.1,
)


def sample(time: float, position: float = 0.2, velocity: float = 0.3) -> Sample:
    return Sample(time, np.array([position]), np.array([velocity]), np.array([0.0]))


def law(position, velocity, command):
    return 2.0 * position, None


def running_guard(spec: ResidualSpec = SPEC, law=law) -> Guard:
    """A guard that has passed the force of the residual at 0.10 s."""
    guard = Guard(spec, law)
    forces = [guard.force(0.01 * k, sample(0.01 * k))[0] for k in range(11)]
    assert forces == [0.0] * 10 + [pytest.approx(0.4)]
    return guard


@pytest.mark.parametrize(
    ("seen", "reason"),
    [
        (None, "no sample"),
        (sample(0.11, position=np.nan), "no sample"),
        (sample(0.11, velocity=np.inf), "no sample"),
        (sample(0.08), "stale sample"),
        (sample(0.12), "stale sample"),
        (sample(0.11, position=1.5), "outside the valid region"),
        (sample(0.11, position=1.0), "outside the valid region"),
        (sample(0.11, velocity=-2.0), "outside the valid region"),
        (sample(0.11, velocity=0.8), "velocity jump"),
    ],
)
def test_the_residual_is_blocked_until_no_fault_has_occurred_for_the_hold_off_time(
    seen: Sample | None, reason: str
) -> None:
    guard = running_guard()
    assert guard.force(0.11, seen)[0] == 0.0
    assert guard.reasons[reason] == 1
    later = [0.12 + 0.01 * k for k in range(1, 14)]
    velocity = 0.3 if reason != "velocity jump" else 0.8
    forces = [guard.force(t, sample(t, velocity=velocity))[0] for t in later]
    first = next(t for t, force in zip(later, forces, strict=True) if force != 0.0)
    assert first >= 0.11 + SPEC.hold_off - 1e-9
    assert forces[-1] == pytest.approx(0.4)


def test_the_force_is_bounded_and_blocked_after_a_long_saturation() -> None:
    guard = running_guard(law=lambda q, v, c: (np.where(q > 0.5, 1e9, 2.0 * q), None))
    times = 0.11 + 0.01 * np.arange(30)
    forces = np.array([guard.force(t, sample(t, position=0.6))[0] for t in times])
    assert set(forces) == {0.5, 0.0}
    assert np.count_nonzero(forces) <= round(SPEC.hold_off / 0.01) + 2
    assert guard.reasons["at its bound for too long"] > 0


@pytest.mark.parametrize(
    ("deviation", "passes"), [([0.05], True), ([0.2], False), ([np.nan], False), (None, False)]
)
def test_an_uncertain_residual_is_blocked(deviation, passes: bool) -> None:
    spec = replace(SPEC, uncertainty=0.1)
    given = None if deviation is None else np.array(deviation)
    guard = Guard(spec, lambda q, v, c: (q, given))
    forces = [guard.force(0.01 * k, sample(0.01 * k))[0] for k in range(12)]
    assert bool(forces[-1]) is passes
    assert (guard.reasons["uncertain"] > 0) is not passes


def test_a_force_that_is_not_finite_is_blocked() -> None:
    guard = Guard(SPEC, lambda q, v, c: (np.array([np.nan]), None))
    assert all(guard.force(0.01 * k, sample(0.01 * k))[0] == 0.0 for k in range(40))
    assert guard.reasons["not finite"] == 40


def test_a_restarted_guard_waits_for_the_hold_off_time_again() -> None:
    guard = running_guard()
    guard.restart()
    assert guard.force(0.11, sample(0.11))[0] == 0.0
    assert guard.reasons["waiting"] == 11
