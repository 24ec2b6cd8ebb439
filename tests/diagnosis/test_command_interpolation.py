"""Detection of how the controller interpolates commands between their stamps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from recorded_pendulum import Reality, cell

from pytest_twin.diagnosis.findings import Estimate, Explanation, Finding
from pytest_twin.diagnosis.locate import TimeAndRegime
from pytest_twin.diagnosis.model_setup import ModelSetup
from pytest_twin.diagnosis.signal_meaning import determine_signals, with_interpolation_uncertainty
from pytest_twin.diagnosis.signal_meaning.command_interpolation import (
    AssumptionResiduals,
    CommandInterpolation,
    decide_interpolation,
)
from pytest_twin.diagnosis.signal_meaning.fact import Fact, unknown
from pytest_twin.diagnosis.signal_meaning.recorded_signals import RecordedSignals
from pytest_twin.diagnosis.signal_meaning.step_times import step_intervals
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.estimation.hypothesis import EMPTY, Term
from pytest_twin.loaded_model import find_model, load_model

NOISE = np.array([1e-4])


def detected(
    folder: Path, reality: Reality, seeds: tuple[int, ...] = (2, 3)
) -> CommandInterpolation:
    """The interpolation that is detected in recordings of a simulated pendulum."""
    model, recordings = cell(folder / "cell", reality, seeds)
    loaded = load_model(find_model(model))
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    (between,) = determine_signals(ModelSetup.of(loaded.realization, None, 1), trials).between
    return between


@pytest.mark.parametrize(
    "reality",
    [
        Reality(between="interpolated"),
        Reality(between="interpolated", lag=0.012),
        pytest.param(
            Reality(between="interpolated", stiffness=0.6, damping=0.8), marks=pytest.mark.nightly
        ),
        Reality(between="interpolated", command_period=0.02),
    ],
    ids=["exact model", "with a lag", "with other gains", "at 50 Hz"],
)
def test_interpolated_commands_are_detected_despite_other_model_errors(
    tmp_path: Path, reality: Reality
) -> None:
    found = detected(tmp_path, reality)
    assert found.fact.value == "interpolated", found.fact.evidence
    assert found.fact.confidence > 0.95
    assert found.delay_change("held") == (0.0, 0.0)


@pytest.mark.parametrize(
    "reality",
    [
        pytest.param(Reality(lag=0.012), marks=pytest.mark.nightly),
        pytest.param(Reality(stiffness=0.6, damping=0.8), marks=pytest.mark.nightly),
        pytest.param(Reality(play=0.01), marks=pytest.mark.nightly),
        Reality(delay=0.008),
        Reality(dry=3.0, viscous=0.4),
        Reality(command_period=0.001, state_period=0.004),
    ],
    ids=["lag", "other gains", "dead zone", "delay", "friction", "1 kHz"],
)
def test_held_commands_are_never_detected_as_interpolated(tmp_path: Path, reality: Reality) -> None:
    found = detected(tmp_path, reality)
    assert found.fact.value in (None, "held"), found.fact.evidence
    assert "held" in found.possible


def test_held_commands_are_detected_at_a_low_command_rate(tmp_path: Path) -> None:
    found = detected(tmp_path, Reality(command_period=0.04, delay=0.01))
    assert found.fact.value == "held", found.fact.evidence


def residual_of(
    rms: float, *, nominal: float = 1.0, delay: float = 0.0, seed: int = 0
) -> AssumptionResiduals:
    noise = np.random.default_rng(seed).standard_normal((2000, 1))
    return AssumptionResiduals(
        1e-4 * rms * noise, np.array([1e-4 * nominal]), True, np.array([delay])
    )


def decision_of(**each: AssumptionResiduals) -> CommandInterpolation:
    return decide_interpolation(each, [1000, 1000], [0, 1], NOISE, 0.004)  # type: ignore[arg-type]


def test_two_assumptions_with_equal_residuals_give_no_result() -> None:
    found = decision_of(
        held=residual_of(1.0, nominal=9.0), interpolated=residual_of(1.02, nominal=9.0)
    )
    assert found.fact.value is None
    assert found.fact.confidence == 0.0
    assert set(found.possible) == {"held", "interpolated"}
    assert found.delay_change("held") == (0.0, 0.002)


def test_the_assumption_without_model_error_is_selected_if_residuals_are_equal() -> None:
    found = decision_of(
        held=residual_of(1.0, nominal=1.05), interpolated=residual_of(1.0, nominal=9.0)
    )
    assert (found.fact.value, found.fact.confidence) == ("held", 0.9)


def test_an_ordinary_delay_of_the_servo_may_hide_a_small_difference() -> None:
    found = decision_of(
        held=residual_of(1.0, nominal=1.2), interpolated=residual_of(1.0, nominal=3.5)
    )
    assert found.fact.value is None


def test_an_open_question_is_left_at_moving_setpoints_only_if_the_model_is_closer() -> None:
    def assumed(held: float, interpolated: float) -> str:
        return decision_of(
            held=residual_of(5.0, nominal=held), interpolated=residual_of(5.0, nominal=interpolated)
        ).assumed

    assert assumed(held=40.0, interpolated=10.0) == "interpolated"
    assert assumed(held=40.0, interpolated=30.0) == "held"
    assert assumed(held=10.0, interpolated=40.0) == "held"


def test_an_open_question_between_other_assumptions_leaves_commands_as_held() -> None:
    found = decision_of(
        held=residual_of(60.0, nominal=1.1), interpolated=residual_of(20.0, nominal=1.8),
        ramped=residual_of(22.0, nominal=0.6),
    )  # fmt: skip
    assert set(found.possible) == {"interpolated", "ramped"}
    assert found.fact.value is None
    assert found.assumed == "held"


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ([0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.6], True),
        ([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], False),
        ([0.0, 0.0, 0.0, 0.1, 0.3, 0.5, 0.6], False),
        ([0.0, 0.0, 0.0, 0.001, 0.001, 0.3, 0.6], False),
        ([0.2, 0.2], False),
    ],
    ids=["step", "ramp", "start of a motion", "small step", "two commands"],
)
def test_a_step_is_a_change_of_a_command_that_rests(command: list[float], expected: bool) -> None:
    assert bool(len(step_intervals(np.array(command)[:, None]))) is expected


def test_steps_between_stamps_do_not_decide_about_smooth_motion(tmp_path: Path) -> None:
    # The line from one stamp to the next is 4 ms late on average.
    reality = Reality("interpolated", command_period=0.01, stepping=True)
    found = detected(tmp_path, reality, (2, 4, 5, 7))
    assert found.fact.value == "interpolated", found.fact.evidence


def two_joints(first_nominal: float, second_nominal: float) -> AssumptionResiduals:
    one = residual_of(1.0)
    residual = np.repeat(one.residual, 2, axis=1)
    nominal = 1e-4 * np.array([first_nominal, second_nominal])
    return AssumptionResiduals(residual, nominal, True, np.zeros(2))


def test_a_joint_with_an_exact_model_decides_for_all_joints() -> None:
    found = decide_interpolation(
        {"held": two_joints(1.0, 50.0), "interpolated": two_joints(9.0, 60.0)},
        [1000, 1000], [0, 1], np.array([1e-4, 1e-4]), 0.01,
    )  # fmt: skip
    assert found.fact.value == "held"
    differing = decide_interpolation(
        {"held": two_joints(1.0, 50.0), "interpolated": two_joints(9.0, 1.0)},
        [1000, 1000], [0, 1], np.array([1e-4, 1e-4]), 0.01,
    )  # fmt: skip
    assert differing.fact.value is None


def test_recordings_that_contradict_each_other_give_no_result() -> None:
    best, other = residual_of(1.0, nominal=9.0), residual_of(3.0, nominal=9.0)
    best.residual[1000:] *= 1.2
    other.residual[1000:] /= 3.0
    assert decision_of(interpolated=best, held=other).fact.value is None


def test_a_slight_reduction_of_a_large_residual_gives_no_result() -> None:
    found = decision_of(
        interpolated=residual_of(8.0, nominal=9.0), held=residual_of(10.0, nominal=11.0)
    )
    assert found.fact.value is None


def test_a_delay_between_those_of_two_assumptions_gives_no_result() -> None:
    clear = decision_of(
        interpolated=residual_of(1.0, nominal=9.0), held=residual_of(1.5, nominal=9.0)
    )
    between_both = decision_of(
        interpolated=residual_of(1.0, nominal=9.0, delay=0.0015), held=residual_of(1.5, nominal=9.0)
    )
    assert clear.fact.value == "interpolated"
    assert between_both.fact.value is None


def explained_by_delay(value: float) -> Explanation:
    estimate = Estimate(value, "s", value - 2e-4, value + 2e-4)
    finding = Finding(
        "command_delay", "j1", 0.99, {"delay": estimate}, TimeAndRegime("", {}), 0.5, 9.0, (),
        "a test", (), Term("command_delay", 0),
    )  # fmt: skip
    return Explanation((finding,), EMPTY)


def open_between(*possible: str) -> CommandInterpolation:
    return CommandInterpolation(unknown("no motion"), possible, 0.004)  # type: ignore[arg-type]


def test_the_interval_of_a_delay_covers_every_possible_setpoint() -> None:
    (found,) = with_interpolation_uncertainty(
        explained_by_delay(0.016), open_between("held", "interpolated")
    ).findings
    assert found.parameters["delay"].low == pytest.approx(0.0158)
    assert found.parameters["delay"].high == pytest.approx(0.0182)
    assert found.confidence == 0.99


def test_a_delay_of_half_a_period_has_half_confidence_if_commands_may_be_ramped() -> None:
    (found,) = with_interpolation_uncertainty(
        explained_by_delay(0.002), open_between("held", "ramped")
    ).findings
    assert found.parameters["delay"].low == 0.0
    assert found.confidence == 0.5
    assert "command_between" in found.next_test


def test_findings_do_not_change_if_the_interpolation_is_known() -> None:
    known = explained_by_delay(0.002)
    assert with_interpolation_uncertainty(known, None) is known


def test_a_declared_interpolation_is_not_estimated(tmp_path: Path) -> None:
    model, recordings = cell(tmp_path / "cell", Reality(between="interpolated"), (2,))
    loaded = load_model(find_model(model))
    options = loaded.options.from_json({"command_between": "held"})
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure, options)
    settled = determine_signals(ModelSetup.of(loaded.realization, None, 1), trials)
    assert settled.between == ()
    stored = settled.to_json(trials.fit)["r2.mcap"]
    assert stored["command_between"]["value"] == "held"
    assert stored["command_between"]["source"] == "option"


def test_the_detected_interpolation_is_stored_for_each_recording(tmp_path: Path) -> None:
    model, recordings = cell(tmp_path / "cell", Reality(), (2,))
    loaded = load_model(find_model(model))
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    answer = CommandInterpolation(
        Fact("interpolated", 0.99, "data", "so it is"), ("interpolated",), 0.004
    )
    settled = RecordedSignals((answer,))
    used = settled.apply(trials)
    assert [t.command_between for t in used.fit] == ["interpolated"]
    assert not any("assumed" in n for n in used.notes)
    assert any("r2.mcap: commands are interpolated between their stamps" in n for n in used.notes)
    stored = json.loads(json.dumps(settled.to_json(used.fit)))
    assert stored["r2.mcap"]["joints"]["j1"]["command_between"]["confidence"] == 0.99


def test_without_recordings_no_interpolation_is_estimated() -> None:
    assert RecordedSignals().apply(TrialSet((), (), ("a note",))).notes == ("a note",)
