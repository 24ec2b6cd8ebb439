"""Effects simulated with other formulas than the catalogue's, and the check of the answers."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import forms

from pytest_twin.effects import catalogue
from pytest_twin.formats.mcap import read_recording


@pytest.fixture(autouse=True)
def short_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use recordings of 1.8 s, less than a third of the benchmark's length, to save time."""
    monkeypatch.setattr(forms, "SECONDS", 1.8)


@pytest.mark.parametrize(
    "form",
    [
        forms.WheelOffItsAxis,
        pytest.param(forms.Smoothed, marks=pytest.mark.nightly),
        pytest.param(forms.HeavyLink, marks=pytest.mark.nightly),
    ],
)
def test_another_formula_of_an_effect_is_named_as_that_effect(
    form: type[forms.Form], tmp_path: Path
) -> None:
    right, line = forms.diagnosed(tmp_path / "case", form)
    assert right, line
    assert line.startswith(f"{form.__name__}: {form.named}; explained, named {form.named} at lift")


def test_a_wrong_answer_is_reported_as_wrong(tmp_path: Path) -> None:
    """No effect is simulated, but the form claims backlash."""

    class Nothing(forms.Form):
        named = "backlash"

    right, line = forms.diagnosed(tmp_path / "case", Nothing)
    assert not right
    assert line.startswith("Nothing: backlash; no_mismatch, named nothing")
    said = json.loads((tmp_path / "case" / "why" / "diagnosis.json").read_text())
    assert said["trials"] == {
        "fit": ["0.mcap", "1.mcap"],
        "held_out": ["2.mcap"],
    }


def test_forms_name_catalogue_effects_and_act_on_one_joint_only(tmp_path: Path) -> None:
    assert {f.named for f in forms.FORMS} - {None} <= set(catalogue())
    seen = []
    for form in (forms.Form, forms.WheelOffItsAxis):
        forms.record(tmp_path / "one.mcap", form(0))
        position = read_recording(tmp_path / "one.mcap").series["state"].position
        assert position is not None
        seen.append(position)
    difference = np.abs(seen[1] - seen[0]).max(axis=0)
    assert difference[forms.HERE] > 0.01
    assert np.delete(difference, forms.HERE).max() == 0.0
