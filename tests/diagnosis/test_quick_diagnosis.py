"""A first look explains the joints that failed, whatever else is off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from two_pendulums import DAMPING, MASS, mjcf, record

from pytest_twin.diagnosis.quick_diagnosis import LikelyEffect, quick_diagnosis
from pytest_twin.formats.mcap import read_recording
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial, make_trial

TOO_MUCH = 0.1
"""N*m*s/rad that the model damps the right joint more than its reality does."""


@pytest.fixture(scope="module")
def both_off(tmp_path_factory: pytest.TempPathFactory) -> tuple[Realization, Trial]:
    """Too much damping on the right, which is most of the error; late commands on the left."""
    folder = tmp_path_factory.mktemp("both")
    right = f'name="right" axis="0 1 0" damping="{DAMPING}"'
    text = mjcf()
    assert right in text
    model = folder / "model.xml"
    model.write_text(text.replace(right, right.replace(f"{DAMPING}", f"{DAMPING + TOO_MUCH}")))
    path = record(folder / "seen.mcap", 1, delay=0.02)
    return load(model), make_trial(read_recording(path))


def suspect(both_off: tuple[Realization, Trial], *failed: str) -> LikelyEffect:
    seen = quick_diagnosis(*both_off, failed=failed)
    return seen.suspects[0]


def test_the_joint_that_failed_is_explained(both_off: tuple[Realization, Trial]) -> None:
    found = suspect(both_off, "right")
    assert (found.place, found.of) == (("viscous_friction", ("right",)), ("right",))
    value, unit = found.values["coefficient"]
    assert unit == "N*m*s/rad"
    assert value == pytest.approx(-TOO_MUCH, rel=0.15)
    assert found.removed > 0.95


def test_so_is_one_whose_error_is_the_smaller(both_off: tuple[Realization, Trial]) -> None:
    found = suspect(both_off, "left")
    assert (found.place, found.of) == (("command_delay", ("left",)), ("left",))
    assert found.values["delay"][0] == pytest.approx(0.02, abs=0.002)


@pytest.mark.parametrize("failed", [("left", "right"), ("tcp",), ()])
def test_where_no_joint_is_told_from_others_all_count(
    both_off: tuple[Realization, Trial], failed: tuple[str, ...]
) -> None:
    found = suspect(both_off, *failed)
    assert (found.place, found.of) == (("viscous_friction", ("right",)), ())


def test_each_joint_that_failed_is_explained_by_its_own_cause(
    both_off: tuple[Realization, Trial],
) -> None:
    seen = quick_diagnosis(*both_off, failed=("left", "right"))
    assert [(s.place, s.of) for s in seen.suspects] == [
        (("viscous_friction", ("right",)), ()),
        (("command_delay", ("left",)), ("left",)),
    ]
    assert seen.unexplained == ()


def looked_at(folder: Path, text: str, **hidden: float) -> LikelyEffect:
    """The only suspect of a recording whose left joint failed, on the model in ``text``."""
    (folder / "model.xml").write_text(text)
    trial = make_trial(read_recording(record(folder / "seen.mcap", 1, **hidden)))
    (found,) = quick_diagnosis(load(folder / "model.xml"), trial, failed=("left",)).suspects
    return found


LIGHTER = mjcf().replace(f'mass="{MASS}"', f'mass="{0.7 * MASS}"', 1)


@pytest.mark.parametrize(
    ("text", "hidden", "effect"),
    [
        (mjcf(), {"delay": 0.02}, "command_delay"),
        (mjcf(), {"lag": 0.02}, "actuator_lag"),
        (mjcf(), {"lag": 0.05}, "actuator_lag"),
        (mjcf(), {"dry": 0.1}, "coulomb_friction"),
        (LIGHTER, {}, "inertial_parameters"),
    ],
)
def test_a_cause_that_others_explain_clearly_worse_is_named_alone(
    tmp_path: Path, text: str, hidden: dict[str, float], effect: str
) -> None:
    found = looked_at(tmp_path, text, **hidden)
    assert (found.place, found.rivals) == ((effect, ("left",)), ())
    assert found.removed > 0.95


def test_a_delay_too_short_to_part_from_a_lag_is_named_beside_it(tmp_path: Path) -> None:
    found = looked_at(tmp_path, mjcf(), delay=0.008)
    named = {found.place, *found.rivals}
    assert {("command_delay", ("left",)), ("actuator_lag", ("left",))} <= named


def test_of_a_long_recording_it_looks_where_what_failed_is_worst(tmp_path: Path) -> None:
    path = record(tmp_path / "long.mcap", 1, seconds=45.0)
    (tmp_path / "model.xml").write_text(mjcf())
    trial = make_trial(read_recording(path))
    read = trial.position.copy()
    # All that the left joint is off by is early; the right one, never right, is knocked late.
    for column, start in ((0, 5.0), (1, 38.0)):
        knocked = (trial.time > start) & (trial.time < start + 0.5)
        read[knocked, column] += 0.2 * np.sin(2 * np.pi * (trial.time[knocked] - start)) ** 2
    read[:, 1] += 0.01 * np.sin(3.0 * trial.time)
    seen = quick_diagnosis(
        load(tmp_path / "model.xml"), replace(trial, position=read), failed=("right",)
    )
    spans = [span for windows in seen.where.windows.values() for span in windows]
    assert any(start < 38.5 and end > 38.0 for start, end in spans)
