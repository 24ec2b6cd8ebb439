"""Onset, slip and rebound of synthetic contact signals."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.metrics import contact

TIME = np.linspace(0.0, 1.0, 1001)


def coulomb(friction: float, normal: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangential force, applied force (N) and travel (m) of 1 kg under an increasing force."""
    applied = 10.0 * TIME
    tangential = np.minimum(applied, friction * normal)
    speed = np.cumsum(applied - tangential) * 1e-3
    return tangential, applied, np.cumsum(speed) * 1e-3


def test_slip_yields_coulomb_coefficient_force_and_time() -> None:
    tangential, applied, travel = coulomb(0.4, 5.0)
    found = contact.slip(
        TIME, np.full(TIME.size, 5.0), tangential, applied, travel, least_travel=1e-3
    )
    assert found is not None
    assert found.friction == pytest.approx(0.4)
    assert found.force == pytest.approx(2.0, rel=0.011)
    assert found.time == pytest.approx(0.2, rel=0.011)


def test_sticking_and_creeping_contacts_have_no_slip() -> None:
    normal = np.full(TIME.size, 5.0)
    tangential, applied, travel = coulomb(3.0, 5.0)
    assert contact.slip(TIME, normal, tangential, applied, travel, least_travel=1e-3) is None
    creep = 0.01 * TIME
    assert contact.slip(TIME, normal, applied, applied, creep, least_travel=1e-3) is None


def test_slip_of_a_frictionless_contact_has_coefficient_zero() -> None:
    tangential, applied, travel = coulomb(0.0, 5.0)
    found = contact.slip(
        TIME, np.full(TIME.size, 5.0), tangential, applied, travel, least_travel=1e-3
    )
    assert found is not None
    assert found.friction == 0.0


def test_rebound_yields_restitution_and_height_of_a_bouncing_ball() -> None:
    drop, restitution, g = 0.05, 0.6, 9.81
    fall = np.sqrt(2.0 * drop / g)
    after = TIME - fall
    up = restitution * g * fall
    height = np.where(after < 0.0, drop - 0.5 * g * TIME**2, up * after - 0.5 * g * after**2)
    touching = np.abs(height) < 2e-4
    touching[0] = False
    landed = int(np.flatnonzero((after > 0.01) & (height < 0.0))[0])
    height[landed:], touching[landed:] = 0.0, True
    velocity = np.where(after < 0.0, -g * TIME, up - g * after)
    velocity[int(np.flatnonzero(touching)[0])] = -g * fall
    found = contact.rebound(height, velocity, touching)
    assert found is not None
    assert found.restitution == pytest.approx(restitution, rel=0.02)
    assert found.height == pytest.approx(restitution**2 * drop, abs=4e-4)


def test_rebound_is_undefined_without_fall_and_zero_without_bounce() -> None:
    still = np.zeros(TIME.size)
    assert contact.rebound(still, still, np.zeros(TIME.size, dtype=bool)) is None
    assert contact.rebound(still, still, np.ones(TIME.size, dtype=bool)) is None
    falling = 0.5 - TIME
    stays = contact.rebound(falling, np.full(TIME.size, -1.0), falling < 0.0)
    assert stays == contact.Rebound(0.0, 0.0)


def test_rest_value_requires_contact_until_the_end() -> None:
    touching = TIME > 0.5
    assert contact.onset(touching) == 501
    assert contact.onset(TIME > 2.0) is None
    assert contact.at_rest(TIME, 3.0 * np.ones(TIME.size), touching) == pytest.approx(3.0)
    touching[-20] = False
    assert contact.at_rest(TIME, TIME, touching) is None
