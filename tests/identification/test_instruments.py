"""Encoder noise in closed loop biases least squares, but not instrumental variables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import JOINTS, closed_loop, true_arm, write_model

from pytest_twin.identification.effort.document import effort_document
from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import load
from pytest_twin.signals import NO_SIGNALS


def simulated_recording(folder: Path, seed: int, noise: float) -> MeasuredRecording:
    time, position, effort, command = closed_loop(true_arm(folder), seed, noise)
    return MeasuredRecording(
        folder / f"{seed}.csv", 0.0, JOINTS, time, position, None, effort,
        np.zeros(2, dtype=bool), np.full(2, np.inf), {}, command=command,
    )  # fmt: skip


def identified(folder: Path, recordings: list[MeasuredRecording]) -> EffortResult:
    return identify_effort(
        load(write_model(folder)),
        MeasuredRecordings(tuple(recordings[:2]), (recordings[2],)),
        NO_SIGNALS,
    )


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[MeasuredRecording]]:
    folder = tmp_path_factory.mktemp("noisy")
    return folder, [simulated_recording(folder, seed, 4e-3) for seed in (1, 2, 3)]


@pytest.fixture(scope="module")
def found(noisy: tuple[Path, list[MeasuredRecording]]) -> EffortResult:
    return identified(*noisy)


def test_least_squares_is_biased_and_instrumental_variables_are_not(
    noisy: tuple[Path, list[MeasuredRecording]], found: EffortResult
) -> None:
    estimate = found.estimate
    assert estimate.estimator == "instrumental variables"
    assert "noise of the positions biases least squares" in estimate.why
    true = found.base.values(Regressor(true_arm(noisy[0]), JOINTS).prior)[found.fitted.kept]
    ours, theirs = found.fitted.solution, estimate.squares
    assert (np.abs(ours.values - true) <= ours.half_width).all()
    inertia = found.base.expressions.index("Iyy1 + Ia1 + 0.25*m2")
    at = int(np.flatnonzero(found.fitted.kept == inertia)[0])
    assert abs(theirs.values[at] - true[at]) > theirs.half_width[at]
    assert abs(ours.values[at] - true[at]) < 0.15 * true[at]


def test_noise_of_the_positions_is_not_taken_for_a_delay(found: EffortResult) -> None:
    # Least squares finds -44 ms.
    assert found.delay is None
    assert found.stages[0].state == "not_observable"


def test_a_delay_is_identified_despite_noise_of_the_positions(tmp_path: Path) -> None:
    late = []
    for seed in (1, 2, 3):
        one = simulated_recording(tmp_path, seed, 1.5e-3)
        columns = [np.interp(one.time - 0.03, one.time, column) for column in one.effort.T]
        late.append(replace(one, effort=np.column_stack(columns)))
    result = identified(tmp_path, late)
    # Least squares finds 19 ms with an interval of 9 ms.
    assert result.delay is not None
    assert abs(result.delay.value - 0.03) <= 1.2 * result.delay.half_width
    assert result.delay.half_width < 0.006


def test_the_document_states_the_estimator_of_each_parameter(found: EffortResult) -> None:
    document = effort_document(found, found.stages, found.errors)
    assert document["estimator"]["name"] == "instrumental variables"
    assert document["estimator"]["endogeneity"]["probability"] < 0.01
    for k, i in enumerate(found.fitted.kept):
        one = document["parameters"][document["covariance"]["names"][k]]
        assert one["estimator"] == "instrumental variables"
        assert one["least_squares"] == found.estimate.squares.values[k], i


def test_without_commands_least_squares_is_used_as_there_is_no_instrument(
    noisy: tuple[Path, list[MeasuredRecording]],
) -> None:
    folder, recordings = noisy
    result = identified(folder, [replace(one, command=None) for one in recordings])
    assert result.estimate.estimator == "weighted least squares"
    assert result.estimate.why == "no instrument: not every joint has position commands"


def test_without_encoder_noise_least_squares_is_used(tmp_path: Path) -> None:
    result = identified(tmp_path, [simulated_recording(tmp_path, seed, 1e-6) for seed in (1, 2, 3)])
    assert result.estimate.estimator == "weighted least squares"
    assert result.estimate.test is not None
