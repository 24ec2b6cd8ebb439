"""Identification of encoder bias and scale from effort, and reports of undetermined ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arms import JOINTS, simulated_effort, true_arm, write_model

from pytest_twin.formats.record_fields import Z95
from pytest_twin.identification.effort.document import effort_document
from pytest_twin.identification.effort.encoders import (
    EncoderError,
    EncoderErrors,
    widen_by_encoder_errors,
)
from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.effort.least_squares import LinearProblem, Solution
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.realization import load
from pytest_twin.signals import NO_SIGNALS


def identified(
    folder: Path, bias: list[float], scale: list[float], late: float = 0.0
) -> EffortResult:
    """Result for two recordings and a held-out one; the encoders measure (1 + scale) q + bias.

    Efforts are stamped ``late`` seconds late.
    """
    runs = []
    for seed in (1, 2, 3):
        time, q, effort = simulated_effort(true_arm(folder), seed)
        effort = np.column_stack([np.interp(time - late, time, one) for one in effort.T])
        runs.append(
            MeasuredRecording(
                folder / f"{seed}.csv", 0.0, JOINTS, time, q * (1 + np.array(scale)) + bias, None,
                effort, np.zeros(2, dtype=bool), np.full(2, np.inf), {},
            )
        )  # fmt: skip
    return identify_effort(
        load(write_model(folder)), MeasuredRecordings(tuple(runs[:2]), (runs[2],)), NO_SIGNALS
    )


def test_encoder_bias_and_scale_are_identified_and_corrected(tmp_path: Path) -> None:
    result = identified(tmp_path, [0.08, 0.0], [0.0, 0.05])
    (stage,) = (one for one in result.stages if one.name == "encoder")
    assert stage.state == "accepted"
    found = {(one.joint, one.kind): one for one in result.encoders.readings}
    for key, true in ((("shoulder", "encoder_bias"), 0.08), (("elbow", "encoder_scale"), 0.05)):
        assert abs(found[key].value - true) <= 1.2 * found[key].half_width, key
        assert found[key].half_width < 0.4 * true, key
    assert stage.held_out is not None
    assert stage.held_out.after < 0.5 * stage.held_out.before


def test_the_encoder_bias_of_the_last_joint_is_reported_as_undetermined(tmp_path: Path) -> None:
    result = identified(tmp_path, [0.0, 0.1], [0.0, 0.0])
    assert ("elbow", "encoder_bias") in result.encoders.undetermined
    document = effort_document(result, result.stages, result.errors)
    (entry,) = (
        one for one in document["unobservable"] if one["expression"] == "elbow.encoder_bias"
    )
    assert entry["motion"] == (
        "hold a known payload (payloads: in twin.yaml) in poses all over the range of elbow"
    )


def test_the_intervals_of_an_encoder_without_error_contain_zero(tmp_path: Path) -> None:
    result = identified(tmp_path, [0.0, 0.0], [0.0, 0.0])
    assert {one.kind for one in result.encoders.readings} == {"encoder_bias", "encoder_scale"}
    assert all(abs(one.value) <= 1.3 * one.half_width for one in result.encoders.readings)
    assert not result.encoders.wrong


def test_corrected_encoders_reopen_the_delay_that_they_change(tmp_path: Path) -> None:
    result = identified(tmp_path, [0.08, 0.0], [0.0, 0.05], late=0.012)
    delay, encoder = result.stages[:2]
    assert (delay.name, delay.state) == ("delay", "reopened")
    assert delay.why.startswith("encoders that were corrected change it: efforts are stamped +1")
    assert encoder.state == "accepted"
    assert result.delay is not None
    assert abs(result.delay.value - 0.012) <= result.delay.half_width


def test_one_uncorrected_error_among_right_encoders_widens_the_intervals() -> None:
    rows = np.random.default_rng(0).standard_normal((200, 1, 2))
    problem = LinearProblem(
        rows, np.zeros((200, 1)), np.ones((200, 1), dtype=bool), np.zeros((200, 1), dtype=bool),
        np.zeros((1, 2), dtype=bool), (200,),
    )  # fmt: skip
    exact = Solution(
        np.ones(2), 1e-6 * np.eye(2), np.ones(1), np.zeros((200, 1)), np.ones((200, 1)), 1.0,
        Z95 * 1e-3 * np.ones(2),
    )  # fmt: skip
    # The error acts like the first parameter: 2 per rad.
    slopes = np.repeat(2.0 * rows[:, :, :1], 4, axis=2)
    noise = 0.01
    for bias in (0.03, 0.0):
        values = (bias, 0.002, -0.003, 0.001)
        readings = tuple(
            EncoderError(f"joint{k}", "encoder_bias", value, Z95 * noise)
            for k, value in enumerate(values)
        )
        found = widen_by_encoder_errors(problem, exact, slopes, EncoderErrors(readings))
        if bias:
            # Nearly the whole estimate of three deviations counts.
            assert 0.9 * 2.0 * bias < found.half_width[0] / Z95 < 1.2 * 2.0 * bias
            assert found.covariance[0, 0] == pytest.approx((found.half_width[0] / Z95) ** 2)
        else:
            assert found.half_width[0] / Z95 < 2.0 * noise
        assert found.half_width[1] == pytest.approx(exact.half_width[1])
