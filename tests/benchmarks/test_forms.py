"""A sample of laws as another author would write them, and what says of them that it is wrong."""

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
    """Two thirds of the benchmark's: the same motion and forms, in two thirds of the time."""
    monkeypatch.setattr(forms, "SECONDS", 4.0)


@pytest.mark.parametrize("form", [forms.WheelOffItsAxis, forms.Smoothed, forms.HeavyLink])
def test_another_form_of_a_law_gets_its_name(form: type[forms.Form], tmp_path: Path) -> None:
    right, line = forms.diagnosed(tmp_path / "case", form)
    assert right, line
    assert line.startswith(f"{form.__name__}: {form.named}; explained, named {form.named} at lift")


def test_a_name_that_is_wrong_is_said(tmp_path: Path) -> None:
    """Nothing hidden, under another name."""

    class Nothing(forms.Form):
        named = "backlash"

    right, line = forms.diagnosed(tmp_path / "case", Nothing)
    assert not right
    assert line.startswith("Nothing: backlash; no_mismatch, named nothing")
    said = json.loads((tmp_path / "case" / "why" / "diagnosis.json").read_text())
    assert said["trials"] == {
        "fit": ["0.mcap", "1.mcap"],
        "validation": [],
        "held_out": ["2.mcap"],
    }


def test_forms_are_of_the_catalogue_and_leave_the_other_joints_alone(tmp_path: Path) -> None:
    assert {f.named for f in forms.FORMS} - {None} <= set(catalogue())
    seen = []
    for form in (forms.Form, forms.WheelOffItsAxis):
        forms.record(tmp_path / "one.mcap", form(0))
        position = read_recording(tmp_path / "one.mcap").series["state"].position
        assert position is not None
        seen.append(position)
    apart = np.abs(seen[1] - seen[0]).max(axis=0)
    assert apart[forms.HERE] > 0.01
    assert np.delete(apart, forms.HERE).max() == 0.0
