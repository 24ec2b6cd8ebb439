"""Rows give the same result on one core and on several."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_twin.effects import batch_division, catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from tests.effects.test_contact_rows import JOINTS, build, segment

LAWS = (
    ("rate_limit", {"inverse_rate": 2.0}),
    ("actuator_lag", {"time_constant": 0.03, "of_setpoint": 1.0}),
    ("dead_zone", {"width": 0.02}),
    ("stribeck_friction", {"coulomb": 0.3, "stiction_excess": 0.2}),
    ("joint_elasticity", {"compliance": 0.01, "damping_time": 0.01}),
    ("payload", {"mass": 0.3, "distance": 0.2}),
)


def test_rows_with_different_effects_do_not_depend_on_the_number_of_cores(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Up to the tolerance of the contact solver: effects of other rows add zeros to a row."""
    monkeypatch.setattr(batch_division, "_FORK_SECONDS", 0.0)
    segments = [segment(build())] * 3
    count = 3 * (len(LAWS) + 1)
    values = {}
    for k, (effect, wanted) in enumerate(LAWS):
        values[effect] = {}
        for p in catalogue()[effect].parameters:
            off = p.starts[0] if p.neutral is None else p.neutral
            array = np.full((count, len(JOINTS)), off)
            array[3 * k : 3 * k + 3] = wanted.get(p.name, off)
            values[effect][p.name] = array
    rows = np.tile(np.arange(3), len(LAWS) + 1)
    found = []
    for cores in (1, 2, 3):
        simulator = BatchSimulator(segments, JOINTS, threads=cores)
        found.append(simulator.simulate(rows, values))
        assert simulator.simulated_steps == count * simulator.steps[0]
    for each in zip(*found, strict=True):
        for name, least in (("position", 1e-8), ("velocity", 1e-6), ("effort", 1e-5)):
            one, *others = (getattr(p, name) for p in each)
            assert np.isfinite(one).all()
            for other in others:
                assert other == pytest.approx(one, rel=0.0, abs=least)
    moved = [np.ptp(p.position - found[0][-1].position) for p in found[0][:-3:3]]
    assert min(moved) > 1e-4
