"""Suspected mistakes of the input are reported with a remedy and not corrected automatically."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import JOINTS, REAL, simulated_effort, true_arm, write_model, write_recording
from scipy import signal

from pytest_twin.errors import RecordingError
from pytest_twin.excitation.approved_limits import MECHANISMS
from pytest_twin.identification.effort.document import effort_document
from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.identification.measured_recordings import (
    MeasuredRecording,
    MeasuredRecordings,
    saturation_level,
)
from pytest_twin.realization import load
from pytest_twin.report.identification import mechanisms, render
from pytest_twin.signals import NO_SIGNALS, Signals


def measured(folder: Path, seed: int, seconds: float = 20.0) -> MeasuredRecording:
    time, q, effort = simulated_effort(true_arm(folder), seed, seconds=seconds)
    return MeasuredRecording(
        folder / f"{seed}.csv", 0.0, JOINTS, time, q, None, effort,
        np.zeros(2, dtype=bool), np.full(2, np.inf), {},
    )  # fmt: skip


def identified_from_two(folder: Path, change) -> EffortResult:
    """The result for three recordings with the same change; the last one is held out."""
    *fit, held = (change(measured(folder, seed)) for seed in (1, 2, 3))
    return identify_effort(
        load(write_model(folder)), MeasuredRecordings((*fit,), (held,)), NO_SIGNALS
    )


def identified(folder: Path, change, signals: Signals = NO_SIGNALS) -> EffortResult:
    """The result for two recordings with the same change; the second one is held out."""
    fit, held = (change(measured(folder, seed)) for seed in (1, 2))
    return identify_effort(load(write_model(folder)), MeasuredRecordings((fit,), (held,)), signals)


def scaled(factors: list[float]):
    return lambda one: replace(one, effort=one.effort * np.array(factors))


def test_a_correct_recording_causes_no_suspicion(tmp_path: Path) -> None:
    assert identified(tmp_path, lambda one: one).suspected == ()


def test_a_wrong_effort_sign_of_one_motor_is_reported(tmp_path: Path) -> None:
    (mistake,) = identified(tmp_path, scaled([1.0, -1.0])).suspected
    assert mistake.what.startswith("elbow: the effort helps the motion")
    assert "its sign is wrong" in mistake.what
    assert mistake.is_fatal


def test_with_a_suspected_wrong_sign_delay_and_encoder_error_are_not_estimated(
    tmp_path: Path,
) -> None:
    result = identified_from_two(tmp_path, scaled([1.0, -1.0]))
    assert [one.is_fatal for one in result.suspected] == [True]
    for stage in result.stages[:2]:
        assert stage.state == "not_observable"
        assert stage.why == (
            "not estimated: a mistake of the input is suspected, and would pass for it"
        )


def test_for_joints_that_hardly_move_the_missing_motions_are_reported(tmp_path: Path) -> None:
    def hardly_moved(one: MeasuredRecording) -> MeasuredRecording:
        random = np.random.default_rng(int(one.effort[0, 0] * 1e6) % 1000)
        turn = 0.02 * np.sin(0.5 * one.time)[:, None] * np.array([1.0, 0.0])
        return replace(
            one,
            position=0.3 + turn + 1e-5 * random.standard_normal(one.position.shape),
            effort=30.0 + 0.05 * random.standard_normal(one.effort.shape),
        )

    result = identified_from_two(tmp_path, hardly_moved)
    document = effort_document(result, result.stages, result.errors)
    assert document["verdict"] == "improved"
    motion = {one["expression"]: one["motion"] for one in document["unobservable"]}
    assert motion["mx2"] == (
        "hold poses in which gravity acts on the link of elbow from several sides"
    )
    assert motion["Iyy1 + Ia1 + 0.25*m2"] == (
        "accelerate shoulder, and the joints before it, in several poses at once"
    )
    # These are mechanisms for which pytest-twin excite designs motions.
    asked = mechanisms(document)
    assert {"gravity", "inertia"} <= set(asked) <= set(MECHANISMS)
    page = render({**document, "frequency_response": []})
    assert f"excitation: mechanisms: [{', '.join(asked)}]" in page


def test_positions_in_degrees_are_reported_even_without_joint_ranges(tmp_path: Path) -> None:
    result = identified(tmp_path, lambda one: replace(one, position=np.degrees(one.position)))
    assert {one.mend for one in result.suspected if "degrees" in one.what} == {
        f"signals: joints: {joint}: position: {{unit: deg}}" for joint in JOINTS
    }


def test_unsigned_effort_without_commands_is_refused_with_a_reason(tmp_path: Path) -> None:
    write_model(tmp_path)
    time, q, effort = simulated_effort(true_arm(tmp_path), 1, about=np.pi / 2)
    write_recording(tmp_path / "one.csv", time, q, np.abs(effort))
    (tmp_path / "out").mkdir()
    with pytest.raises(RecordingError) as error:
        identify_files({
            "model": str(tmp_path / "model.xml"), "recordings": [str(tmp_path / "one.csv")],
            "held_out": [], "out": str(tmp_path / "out"), "name": "unsigned",
        })  # fmt: skip
    assert (
        "no command messages, and no effort that can be used: shoulder: effort never changes"
        in (str(error.value))
    )
    assert "(expected commands in the file" in str(error.value)


@pytest.mark.parametrize(("constant", "noise"), [(0.0, 0.3), (2.0, 0.1)])
def test_an_unsigned_effort_with_noise_or_a_constant_is_reported(
    tmp_path: Path, constant: float, noise: float
) -> None:
    runs = []
    for seed in (1, 2):
        # The arm hangs down, so that efforts change their sign.
        time, q, effort = simulated_effort(true_arm(tmp_path), seed, about=np.pi / 2)
        random = np.random.default_rng(seed)
        amount = np.abs(effort) + constant + noise * random.standard_normal(effort.shape)
        runs.append(MeasuredRecording(
            tmp_path / f"{seed}.csv", 0.0, JOINTS, time, q, None, amount,
            np.zeros(2, dtype=bool), np.full(2, np.inf), {},
        ))  # fmt: skip
    robot = load(write_model(tmp_path))
    found = identify_effort(robot, MeasuredRecordings((runs[0],), (runs[1],)), NO_SIGNALS).suspected
    assert [one.what.partition(":")[0] for one in found] == list(JOINTS)
    assert all("it is an amount, without a sign" in one.what and one.is_fatal for one in found)


def test_a_saturated_effort_leaves_the_parameters_unbiased(tmp_path: Path) -> None:
    def clipped(one: MeasuredRecording) -> MeasuredRecording:
        effort = one.effort.copy()
        effort[:, 0] = np.clip(effort[:, 0], -24.0, 24.0)
        return replace(one, effort=effort, limit=np.array([24.0, np.inf]))

    result = identified(tmp_path, clipped)
    assert result.samples[0].saturated[:, 0].mean() > 0.2
    names = [result.base.names[i] for i in result.fitted.kept]
    values = dict(zip(names, result.fitted.solution.values, strict=True))
    assert values["shoulder.viscous_friction"] == pytest.approx(REAL["damping"], rel=0.1)
    assert values["shoulder.coulomb_friction"] == pytest.approx(REAL["friction"], rel=0.1)


def test_a_gear_ratio_not_applied_to_the_effort_is_reported(tmp_path: Path) -> None:
    signals = Signals.from_json({"joints": {"elbow": {"gear": 50.0}}})
    (mistake,) = identified(tmp_path, scaled([1.0, 0.02]), signals).suspected
    assert "elbow: the effort is 0.0" in mistake.what
    assert mistake.what.endswith("the gear ratio 50 is not applied to the effort")
    assert mistake.mend == "signals: joints: elbow: side of position and effort, and gear"


def test_a_gear_ratio_applied_in_the_wrong_direction_is_reported(tmp_path: Path) -> None:
    signals = Signals.from_json({"joints": {"shoulder": {"gear": 50.0}}})
    (mistake,) = identified(tmp_path, scaled([2500.0, 1.0]), signals).suspected
    assert mistake.what.endswith("the gear ratio 50 is applied the wrong way round")


def test_friction_that_decreases_during_a_recording_is_reported(tmp_path: Path) -> None:
    def warming(one: MeasuredRecording) -> MeasuredRecording:
        way = np.sign(np.gradient(one.position[:, 0]))
        fall = 0.4 * (0.5 - one.time / one.time[-1])
        effort = one.effort.copy()
        effort[:, 0] += fall * way
        return replace(one, effort=effort)

    (mistake,) = identified(tmp_path, warming).suspected
    assert mistake.what.startswith("shoulder: dry friction changes by -")
    assert not mistake.is_fatal


def drifting(share: float, column) -> object:
    """A change that adds (1/2 - t/T) times ``share`` times a column to the shoulder's effort."""

    def drifted(one: MeasuredRecording) -> MeasuredRecording:
        effort = one.effort.copy()
        fall = share * (0.5 - one.time / one.time[-1])
        effort[:, 0] += fall * column(np.gradient(one.position[:, 0], one.time))
        return replace(one, effort=effort)

    return drifted


def test_viscous_friction_that_decreases_during_a_recording_is_reported(tmp_path: Path) -> None:
    (mistake,) = identified(tmp_path, drifting(REAL["damping"], lambda v: v)).suspected
    assert mistake.what.startswith("shoulder: viscous friction changes by -")
    assert not mistake.is_fatal


def test_a_zero_of_the_effort_that_drifts_is_reported(tmp_path: Path) -> None:
    (mistake,) = identified(tmp_path, drifting(4.0, np.ones_like)).suspected
    assert mistake.what.startswith("shoulder: the constant effort changes by -")
    assert "the zero of its sensor drifts" in mistake.what
    assert not mistake.is_fatal


@pytest.mark.parametrize("late", [0.012, -0.008])
def test_a_delay_of_the_efforts_is_identified_and_corrected(tmp_path: Path, late: float) -> None:
    def delayed(one: MeasuredRecording) -> MeasuredRecording:
        columns = [np.interp(one.time - late, one.time, column) for column in one.effort.T]
        return replace(one, effort=np.column_stack(columns))

    result = identified(tmp_path, delayed)
    assert result.stages[0].state == "accepted"
    assert result.delay is not None
    assert result.delay.value == pytest.approx(late, abs=0.003)
    plain = identified(tmp_path, lambda one: one)
    assert plain.stages[0].state == "not_observable"


def low_passed(order: int, cutoff: float):
    """A change that low-pass filters the efforts, as a filter in the drive does; cutoff in Hz."""

    def filtered(one: MeasuredRecording) -> MeasuredRecording:
        b, a = signal.butter(order, cutoff, fs=one.rate)
        at_rest = signal.lfilter_zi(b, a)
        columns = [signal.lfilter(b, a, c, zi=at_rest * c[0])[0] for c in one.effort.T]
        return replace(one, effort=np.column_stack(columns))

    return filtered


def test_a_first_order_filter_of_the_efforts_is_identified_and_corrected(tmp_path: Path) -> None:
    result = identified(tmp_path, low_passed(1, 2.0))
    assert result.delay is not None
    assert result.delay.name == "robot.effort_lag"
    assert result.delay.value == pytest.approx(1.0 / (2.0 * np.pi * 2.0), abs=0.002)
    stage = result.stages[0]
    assert stage.state == "accepted"
    assert stage.why.startswith("efforts pass a low-pass filter with a time constant of 79.")
    kept = [result.base.names[i] for i in result.fitted.kept]
    at = kept.index("shoulder.coulomb_friction")
    solution = result.fitted.solution
    assert abs(solution.values[at] - REAL["friction"]) < solution.half_width[at]


def test_a_filter_with_cutoff_above_the_motion_is_identified_as_a_delay(tmp_path: Path) -> None:
    result = identified(tmp_path, low_passed(2, 10.0))
    assert result.delay is not None
    assert result.delay.name == "robot.effort_delay"
    assert result.delay.value == pytest.approx(np.sqrt(2.0) / (2.0 * np.pi * 10.0), abs=0.001)


def test_clipping_of_an_effort_is_detected() -> None:
    wave = 5.0 * np.sin(np.linspace(0, 20, 2000))
    assert saturation_level(np.clip(wave, -3.0, 3.0)) == 3.0
    assert saturation_level(wave + 0.01 * np.random.default_rng(0).standard_normal(2000)) is None


def test_parameters_of_a_joint_at_rest_are_unobservable(tmp_path: Path) -> None:
    def stood(one: MeasuredRecording) -> MeasuredRecording:
        position = one.position.copy()
        position[:, 1] = 0.3
        return replace(one, position=position)

    result = identified(tmp_path, stood)
    left = {result.base.names[i] for i in np.flatnonzero(result.unobservable)}
    assert {"elbow.viscous_friction", "elbow.coulomb_friction", "elbow.armature"} <= left
