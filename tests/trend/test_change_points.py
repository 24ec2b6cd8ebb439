"""Changes of a series of sessions, and how often one seems to be there by chance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from pytest_twin.trend.change_points import (
    Alarm,
    changes_of,
    declared_steps,
    detectable,
    switches_between_levels,
)
from pytest_twin.trend.tails import NORMAL, drawn, tails_of

LEVEL = 0.05
NOTHING = np.zeros((20, 0))


def changes(value: np.ndarray, **changed: object) -> list[object]:
    given: dict[str, object] = {
        "std": np.full(len(value), 0.1),
        "date": np.arange(len(value), dtype=float),
        "declared": np.zeros((len(value), 0)),
    }
    alarm = Alarm(LEVEL, changed.pop("series", 10), changed.pop("tails", NORMAL))  # type: ignore[arg-type]
    return changes_of(value, **{**given, **changed}, alarm=alarm)  # type: ignore[arg-type, return-value]


@pytest.mark.parametrize("sessions", [4, 6, 20])
def test_alarms_where_nothing_changes_are_as_frequent_as_the_level(sessions: int) -> None:
    random = np.random.default_rng(sessions)
    histories, series = 150, 10
    alarms = sum(
        any(changes(random.standard_normal(sessions)) for _ in range(series))
        for _ in range(histories)
    )
    low, high = binom.interval(0.999, histories, LEVEL)
    assert low <= alarms <= high


@pytest.mark.parametrize("freedom", [4.0, np.inf])
def test_heavy_tails_of_all_series_raise_no_more_alarms_than_the_level(freedom: float) -> None:
    random = np.random.default_rng(21)
    histories, series = 60, 16
    alarms = 0
    for _ in range(histories):
        values = drawn(random, freedom, (series, 20))
        tails = tails_of(list(values))
        alarms += any(changes(one, series=series, tails=tails) for one in values)
    low, high = binom.interval(0.999, histories, LEVEL)
    assert low <= alarms <= high


def test_a_change_in_one_of_many_series_does_not_look_like_heavy_tails() -> None:
    values = np.random.default_rng(22).standard_normal((36, 20))
    values[3, -1] += 12.0
    values[4, 10:] += 8.0
    tails = tails_of(list(values))
    assert tails > 6.0
    assert changes(values[3], series=36, tails=tails)[0].after == 19
    assert tails_of(list(values[:2])) == NORMAL


def test_a_step_is_found_between_its_sessions_with_its_size() -> None:
    value = np.random.default_rng(1).standard_normal(20) + 5.0 * (np.arange(20) >= 12)
    (found,) = changes(value)
    assert (found.kind, found.after) == ("step", 12)
    assert abs(found.size - 5.0) < 3.0 * found.std


def test_a_change_in_the_last_session_alone_is_found() -> None:
    value = np.random.default_rng(2).standard_normal(20)
    value[-1] += 12.0
    found = changes(value)[0]
    assert (found.kind, found.after) == ("step", 19)


def test_a_slow_drift_is_a_drift_and_not_a_step() -> None:
    value = np.random.default_rng(3).standard_normal(20) + 0.5 * np.arange(20)
    found = changes(value)[0]
    assert found.kind == "drift"
    assert found.size == pytest.approx(9.5, abs=3.0)


def test_a_gap_between_dates_counts_as_time_for_a_drift() -> None:
    date = np.concatenate([np.arange(10.0), 100.0 + np.arange(10.0)])
    value = 0.1 * date + 0.3 * np.random.default_rng(4).standard_normal(20)
    found = changes(value, date=date)[0]
    assert found.size == pytest.approx(10.9, abs=1.5)


def test_what_the_temperature_explains_is_no_change() -> None:
    random = np.random.default_rng(5)
    temperature = 20.0 + 10.0 * np.sin(np.arange(20) / 3.0)
    value = 0.5 * temperature + 0.3 * random.standard_normal(20)
    declared = (temperature - temperature.mean())[:, None]
    assert changes(value)
    assert not changes(value, declared=declared)


def test_a_step_at_a_declared_event_is_no_change_and_one_elsewhere_is() -> None:
    value = np.random.default_rng(6).standard_normal(20) + 8.0 * (np.arange(20) >= 12)
    date = np.arange(20.0)
    assert not changes(value, declared=declared_steps([11.5], date))
    assert changes(value, declared=declared_steps([4.5], date))


def test_an_event_outside_the_history_declares_nothing() -> None:
    assert declared_steps([-1.0, 50.0], np.arange(20.0)).shape == (20, 0)


def test_a_change_of_the_size_of_the_warm_up_is_no_alarm() -> None:
    value = 0.1 * np.random.default_rng(7).standard_normal(20) + 1.0 * (np.arange(20) >= 12)
    assert changes(value)
    assert not changes(value, tolerated=1.1)


def test_steps_of_the_detectable_size_are_found_about_every_second_time() -> None:
    random = np.random.default_rng(8)
    count = hits = 0
    for _ in range(60):
        value = random.standard_normal(20)
        size = detectable(value, np.full(20, 0.1), NOTHING, Alarm(LEVEL, 10))
        hits += bool(changes(value + size * (np.arange(20) >= 10)))
        count += 1
    assert 0.25 * count < hits < 0.85 * count


def test_two_levels_that_alternate_are_not_one_change() -> None:
    random = np.random.default_rng(9)
    value = 0.1 * random.standard_normal(16) + np.tile([0.0, 2.0], 8)
    assert switches_between_levels(value) >= 10
    assert switches_between_levels(np.sort(value)) == 1
    assert not any(switches_between_levels(random.standard_normal(16)) for _ in range(200))
