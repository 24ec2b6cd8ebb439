"""The simulation cache returns rows simulated before, and only those."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pytest_twin.effects.active_effects import EffectValues
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Predicted
from pytest_twin.effects.simulation_cache import SimulationCache, row_keys
from tests.effects.test_contact_rows import JOINTS, build, segment


def viscous_friction(*coefficients: float) -> EffectValues:
    """Viscous friction with one row per coefficient."""
    column = np.array(coefficients)[:, None]
    return {"viscous_friction": {"coefficient": np.repeat(column, len(JOINTS), axis=1)}}


@pytest.fixture
def simulator() -> BatchSimulator:
    """A simulator of two equal segments."""
    one = segment(build())
    return BatchSimulator([one, replace(one)], JOINTS, threads=1)


def test_a_row_simulated_before_is_returned_from_the_cache(simulator: BatchSimulator) -> None:
    rows = np.zeros(3, dtype=np.int64)
    first = simulator.simulate(rows, viscous_friction(0.1, 0.2, 0.1))
    once = int(simulator.steps[0])
    assert (simulator.simulated_steps, simulator.cached_steps) == (3 * once, once)
    again = simulator.simulate(rows[:2], viscous_friction(0.2, 0.3))
    assert (simulator.simulated_steps, simulator.cached_steps) == (5 * once, 2 * once)
    assert again[0] is first[1]
    assert first[0] is first[2]
    fresh = BatchSimulator(simulator.segments, JOINTS, threads=1).simulate(
        rows[:1], viscous_friction(0.3)
    )
    assert np.array_equal(again[1].position, fresh[0].position)
    assert not np.array_equal(again[1].position, again[0].position)


def test_an_effect_at_neutral_values_shares_the_cached_nominal_row(
    simulator: BatchSimulator,
) -> None:
    bare = simulator.simulate(np.zeros(1, dtype=np.int64), {})
    damping = simulator.simulate(np.zeros(2, dtype=np.int64), viscous_friction(0.0, 0.1))
    assert damping[0] is bare[0]
    assert damping[1] is not bare[0]


def test_a_changed_initial_position_is_simulated_again(simulator: BatchSimulator) -> None:
    rows = np.array([0, 1])
    before = simulator.simulate(rows, {})
    shifted = simulator.segments[0].initial_position + 0.01
    simulator.segments[0] = replace(simulator.segments[0], initial_position=shifted)
    after = simulator.simulate(rows, {})
    assert after[1] is before[1]
    assert abs(after[0].position[0] - before[0].position[0]).max() > 0.005


def test_cache_keys_differ_by_effect_and_joint() -> None:
    """The same value on another joint or of another effect is another row."""
    one = segment(build())
    values = {
        name: {parameter: np.zeros((4, len(JOINTS)))}
        for name, parameter in (("coulomb_friction", "coulomb"), ("armature", "inertia"))
    }
    values["coulomb_friction"]["coulomb"][0, 0] = 0.1
    values["coulomb_friction"]["coulomb"][1, 1] = 0.1
    values["armature"]["inertia"][2, 0] = 0.1
    keys = row_keys([one] * 4, values)
    assert len(set(keys)) == 4
    assert keys[3] == row_keys([one], {})[0]
    assert keys[3] != row_keys([replace(one)], {})[0]


def test_the_cache_drops_the_least_recently_used_row() -> None:
    one = segment(build())
    size = 100
    known = SimulationCache(most_bytes=2 * 3 * 8 * size)
    for name in (b"a", b"b"):
        known.store((id(one), name), one, Predicted(*np.ones((3, size, 1))))
    assert known.get((id(one), b"a")) is not None
    known.store((id(one), b"c"), one, Predicted(*np.ones((3, size, 1))))
    assert known.get((id(one), b"b")) is None
    assert known.get((id(one), b"a")) is not None


def test_cached_predictions_are_read_only(simulator: BatchSimulator) -> None:
    (found,) = simulator.simulate(np.zeros(1, dtype=np.int64), {})
    with pytest.raises(ValueError, match="read-only"):
        found.position += 1.0
