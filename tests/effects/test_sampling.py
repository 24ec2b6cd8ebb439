"""Interpolation of a simulated motion at the stamps of the readings."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from pytest_twin.effects import catalogue
from pytest_twin.effects.sampling import age_of_initial_state, predicted_readings
from pytest_twin.effects.segment import Segment

STEP, STEPS = 0.01, 100


def segment(start: float, time: np.ndarray, *, starts_in_motion: bool = False) -> Segment:
    none = np.zeros((len(time), 1))
    return Segment(
        trial=0, model=mujoco.MjModel.from_xml_string("<mujoco/>"), mode="effort", start=start,
        time=time, position=none, velocity=None, effort=None, command_time=time, command=none,
        initial_position=np.zeros(1), initial_velocity=np.zeros(1),
        history=(time, none, none) if starts_in_motion else None,
    )  # fmt: skip


def test_a_cubic_motion_is_interpolated_without_position_error() -> None:
    """For any stamps; rows of different lengths do not mix."""
    rng = np.random.default_rng(0)
    stamps = [np.sort(rng.uniform(2.0, 2.0 + STEP * STEPS, n)) for n in (7, 40)]
    segments = [segment(2.0, t) for t in stamps]
    cubic = np.polynomial.Polynomial([0.3, -1.0, 4.0, -2.5])
    at = STEP * np.arange(STEPS + 1)
    rows = tuple(np.tile(x(at)[:, None], (2, 1, 1)) for x in (cubic, cubic.deriv(), cubic))
    found = predicted_readings(segments, [], rows, STEP)  # type: ignore[arg-type]
    for predicted, time in zip(found, stamps, strict=True):
        assert predicted.position[:, 0] == pytest.approx(cubic(time - 2.0), abs=1e-12)
        bend = np.abs(cubic.deriv(3)(0.0)) * STEP**2 / 8.0
        assert predicted.velocity[:, 0] == pytest.approx(cubic.deriv()(time - 2.0), abs=bend)
        # Effort is constant over a step.
        held = at[np.floor((time - 2.0) / STEP).astype(int)]
        assert predicted.effort[:, 0] == pytest.approx(cubic(held), abs=1e-12)


def test_sensor_delay_shifts_the_start_of_windows_but_not_of_whole_recordings() -> None:
    time = 1.0 + STEP * np.arange(5)
    late = [(catalogue()["sensor_delay"], {"delay": np.full((2, 1), 0.03)})]
    found = age_of_initial_state(
        [segment(1.0, time), segment(1.0, time, starts_in_motion=True)], late, 1
    )
    assert found[:, 0] == pytest.approx([0.0, 0.03])
