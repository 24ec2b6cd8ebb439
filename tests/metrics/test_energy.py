"""Energy that came from nowhere."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.metrics.energy import energy_growth

TIME = np.linspace(0.0, 1.0, 101)
NOTHING = np.zeros(101)


def test_a_passive_system_only_loses() -> None:
    assert energy_growth(np.exp(-TIME), NOTHING, NOTHING) == 0.0


def test_work_of_servos_is_no_growth() -> None:
    work = 3.0 * TIME
    assert energy_growth(np.exp(-TIME) + work, work, NOTHING) == pytest.approx(0.0, abs=1e-12)


def test_a_rebound_is_no_growth() -> None:
    # A contact takes energy in and gives most of it back.
    contact = -np.exp(-(((TIME - 0.5) / 0.1) ** 2))
    contact[50:] = np.minimum(contact[50:], -0.2)
    assert energy_growth(2.0 + contact, NOTHING, contact) == pytest.approx(0.0, abs=1e-12)


def test_growth_late_in_a_decay_is_found() -> None:
    energy = np.exp(-10.0 * TIME)
    energy[60:] += 0.01
    assert energy_growth(energy, NOTHING, NOTHING) == pytest.approx(0.01, rel=0.05)


def test_a_contact_that_feeds_energy_is_found() -> None:
    pushed = 0.5 * TIME
    assert energy_growth(1.0 + pushed, NOTHING, pushed) == pytest.approx(0.5)
