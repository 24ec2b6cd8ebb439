"""A quick diagnosis explains the joints that failed, also if other joints have larger errors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import DAMPING, MASS, mjcf, record

from pytest_twin.diagnosis.likely_effect import LikelyEffect
from pytest_twin.diagnosis.quick_diagnosis import quick_diagnosis
from pytest_twin.formats.mcap import read_recording
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial, make_trial

EXCESS = 0.1
"""Excess of the model's damping at the right joint, N*m*s/rad."""


@pytest.fixture(scope="module")
def two_errors(tmp_path_factory: pytest.TempPathFactory) -> tuple[Realization, Trial]:
    """The right joint has excess damping, the larger error; the left one has a command delay."""
    folder = tmp_path_factory.mktemp("both")
    right = f'name="right" axis="0 1 0" damping="{DAMPING}"'
    text = mjcf()
    assert right in text
    model = folder / "model.xml"
    model.write_text(text.replace(right, right.replace(f"{DAMPING}", f"{DAMPING + EXCESS}")))
    path = record(folder / "seen.mcap", 1, seconds=2.2, delay=0.02)
    return load(model), make_trial(read_recording(path))


def first_effect(two_errors: tuple[Realization, Trial], *failed: str) -> LikelyEffect:
    seen = quick_diagnosis(*two_errors, failed=failed)
    return seen.likely_effects[0]


def test_the_failed_joint_is_explained(two_errors: tuple[Realization, Trial]) -> None:
    found = first_effect(two_errors, "right")
    assert (found.place, found.explained_joints) == (("viscous_friction", ("right",)), ("right",))
    value, unit = found.values["coefficient"]
    assert unit == "N*m*s/rad"
    assert value == pytest.approx(-EXCESS, rel=0.15)
    assert found.removed_share > 0.95


def test_a_failed_joint_with_the_smaller_error_is_explained(
    two_errors: tuple[Realization, Trial],
) -> None:
    found = first_effect(two_errors, "left")
    assert (found.place, found.explained_joints) == (("command_delay", ("left",)), ("left",))
    assert found.values["delay"][0] == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize(
    "failed",
    [
        pytest.param(("tcp",), id="no joint but the TCP"),
        pytest.param((), id="none", marks=pytest.mark.nightly),
    ],
)
def test_without_a_failed_joint_the_largest_error_is_explained(
    two_errors: tuple[Realization, Trial], failed: tuple[str, ...]
) -> None:
    found = first_effect(two_errors, *failed)
    assert (found.place, found.explained_joints) == (("viscous_friction", ("right",)), ("right",))


def test_each_joint_that_failed_is_explained_by_its_own_cause(
    two_errors: tuple[Realization, Trial],
) -> None:
    seen = quick_diagnosis(*two_errors, failed=("left", "right"))
    assert [(s.place, s.explained_joints) for s in seen.likely_effects] == [
        (("viscous_friction", ("right",)), ("right",)),
        (("command_delay", ("left",)), ("left",)),
    ]
    assert seen.unexplained == ()


def only_effect(folder: Path, text: str, **hidden: float) -> LikelyEffect:
    """The only likely effect of a recording whose left joint failed; ``text`` is its model."""
    (folder / "model.xml").write_text(text)
    trial = make_trial(read_recording(record(folder / "seen.mcap", 1, seconds=2.2, **hidden)))
    (found,) = quick_diagnosis(load(folder / "model.xml"), trial, failed=("left",)).likely_effects
    return found


LIGHTER = mjcf().replace(f'mass="{MASS}"', f'mass="{0.7 * MASS}"', 1)


@pytest.mark.parametrize(
    ("text", "hidden", "effect"),
    [
        (mjcf(), {"delay": 0.02}, "command_delay"),
        (mjcf(), {"lag": 0.02}, "actuator_lag"),
        pytest.param(mjcf(), {"lag": 0.05}, "actuator_lag", marks=pytest.mark.nightly),
        (mjcf(), {"dry": 0.1}, "coulomb_friction"),
        (LIGHTER, {}, "inertial_parameters"),
    ],
    ids=["delay", "lag of 20 ms", "lag of 50 ms", "dry friction", "heavier link"],
)
def test_an_effect_is_named_alone_if_the_others_explain_clearly_less(
    tmp_path: Path, text: str, hidden: dict[str, float], effect: str
) -> None:
    found = only_effect(tmp_path, text, **hidden)
    assert (found.place, found.alternatives) == ((effect, ("left",)), ())
    assert found.removed_share > 0.95


def test_no_effect_is_named_that_removes_a_small_part_of_the_error(tmp_path: Path) -> None:
    """Somebody pushes the joint; an actuator lag would remove 1.5 % of that."""
    (tmp_path / "model.xml").write_text(mjcf())
    trial = make_trial(read_recording(record(tmp_path / "seen.mcap", 1, seconds=2.2)))
    read = trial.position.copy()
    for start, push in ((0.4, 0.1), (0.9, 0.1), (1.3, 0.1), (1.8, -0.1)):
        pushed = (trial.time > start) & (trial.time < start + 0.2)
        read[pushed, 0] += push * np.sin(np.pi * (trial.time[pushed] - start) / 0.2) ** 2
    seen = quick_diagnosis(
        load(tmp_path / "model.xml"), replace(trial, position=read), failed=("left",)
    )
    assert (seen.likely_effects, seen.unexplained) == ((), ("left",))


def test_a_delay_of_less_than_two_command_periods_is_named(tmp_path: Path) -> None:
    found = only_effect(tmp_path, mjcf(), delay=0.008)
    assert found.place == ("command_delay", ("left",))
    assert found.values["delay"][0] == pytest.approx(0.008, abs=0.001)


def test_a_long_recording_is_cut_to_the_largest_error_of_the_failed_joint(tmp_path: Path) -> None:
    path = record(tmp_path / "long.mcap", 1, seconds=45.0)
    (tmp_path / "model.xml").write_text(mjcf())
    trial = make_trial(read_recording(path))
    read = trial.position.copy()
    # The left joint has its error at 5 s. The right joint has an error throughout, and its largest
    # one at 38 s.
    for column, start in ((0, 5.0), (1, 38.0)):
        disturbed = (trial.time > start) & (trial.time < start + 0.5)
        read[disturbed, column] += 0.2 * np.sin(2 * np.pi * (trial.time[disturbed] - start)) ** 2
    read[:, 1] += 0.01 * np.sin(3.0 * trial.time)
    seen = quick_diagnosis(
        load(tmp_path / "model.xml"), replace(trial, position=read), failed=("right",)
    )
    spans = [span for windows in seen.where.windows.values() for span in windows]
    assert any(start < 38.5 and end > 38.0 for start, end in spans)
