"""Energy growth: increase of energy beyond the work of actuators and contacts."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.metrics.energy import energy_growth

TIME = np.linspace(0.0, 1.0, 101)
NOTHING = np.zeros(101)


def test_a_dissipating_system_has_no_energy_growth() -> None:
    assert energy_growth(np.exp(-TIME), NOTHING, NOTHING) == 0.0


def test_servo_work_is_not_energy_growth() -> None:
    work = 3.0 * TIME
    assert energy_growth(np.exp(-TIME) + work, work, NOTHING) == pytest.approx(0.0, abs=1e-12)


def test_energy_returned_by_a_contact_is_not_growth() -> None:
    # A contact stores energy and returns most of it.
    contact = -np.exp(-(((TIME - 0.5) / 0.1) ** 2))
    contact[50:] = np.minimum(contact[50:], -0.2)
    assert energy_growth(2.0 + contact, NOTHING, contact) == pytest.approx(0.0, abs=1e-12)


def test_energy_growth_during_a_late_decay_is_detected() -> None:
    energy = np.exp(-10.0 * TIME)
    energy[60:] += 0.01
    assert energy_growth(energy, NOTHING, NOTHING) == pytest.approx(0.01, rel=0.05)


def test_energy_added_by_a_contact_is_detected() -> None:
    pushed = 0.5 * TIME
    assert energy_growth(1.0 + pushed, NOTHING, pushed) == pytest.approx(0.5)
