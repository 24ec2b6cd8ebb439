"""``servos:`` of a twin decides what recordings of commands and positions leave open."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
import yaml
from test_identify_simulation import MODEL, NOMINAL, REAL, write_trial

from pytest_twin import cli
from pytest_twin.formats.schema import load_schema

pytestmark = pytest.mark.usefixtures("commands_in_process")
KNOWN = {
    "damping": {"value": 0.3, "unit": "N*m*s/rad", "ci95": [0.27, 0.33]},
    "stiffness": {"value": 10.0, "unit": "N*m/rad", "ci95": [9.7, 10.3]},
    "armature": {"value": 0.01, "unit": "kg*m^2", "ci95": [0.009, 0.011]},
}
"""Of the servo, whose damping is right and whose stiffness is 8 N*m/rad on this robot."""


def twin_in(folder: Path) -> list[str]:
    """A twin with the servo, and two recordings to fit and one to test: arguments of a command."""
    (folder / "model.xml").write_text(MODEL.format(**NOMINAL))
    servo = {"id": "mine", "joints": ["swing"], "parameters": KNOWN}
    twin = {"schema": 1, "model": "model.xml", "servos": [servo], "command_between": "held"}
    (folder / "twin.yaml").write_text(yaml.safe_dump(twin))
    paths = [str(write_trial(folder / f"{n}.csv", s)) for n, s in
             (("one", 1), ("two", 2), ("check", 3))]  # fmt: skip
    return [str(folder / "twin.yaml"), *paths[:2], "--held-out", paths[2]]


def test_an_identification_takes_from_the_servo_what_the_motion_does_not_show(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(["identify", *twin_in(tmp_path), "--out", str(tmp_path / "out")])
    document = json.loads((tmp_path / "out/identification.json").read_text())
    jsonschema.validate(document, load_schema("results/identify.schema.json"))
    priors = {use["parameter"]: use for use in document["priors"]}
    assert priors["damping"]["state"] == "combined"
    low, high = priors["damping"]["combined"]["ci95"]
    assert low <= 0.3 <= high
    assert high - low <= 0.0601
    assert priors["stiffness"]["state"] == "contradicted"
    assert priors["stiffness"]["data"]["value"] == pytest.approx(REAL["kp"], abs=0.1)
    parameters = document["parameters"]
    gain = parameters["swing.controller_gain.stiffness_error"]
    assert gain["value"] == pytest.approx(-0.2, abs=0.01)
    low, high = parameters["swing.controller_gain.damping_error"]["ci95"]
    assert high - low <= 0.21
    words = capsys.readouterr().out
    assert "Prior: damping of swing as of servo mine, 0.3" in words
    assert "contradict it" in words
    assert "Priors of the servos" in (tmp_path / "out/identification.html").read_text()
    assert any("servo:swing" in part for part in document["basis"]["parts"])


@pytest.mark.nightly
def test_a_diagnosis_says_what_it_did_with_each_prior(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(["diagnose", *twin_in(tmp_path), "--seconds", "60", "--out", str(tmp_path / "out")])
    document = json.loads((tmp_path / "out/diagnosis.json").read_text())
    jsonschema.validate(document, load_schema("results/diagnosis.schema.json"))
    states = {use["parameter"]: use["state"] for use in document["priors"]}
    assert states["stiffness"] == "contradicted"
    assert states["damping"] == "combined"
    (friction,) = (f for f in document["findings"] if f["effect"] == "viscous_friction")
    assert friction["parameters"]["coefficient"]["value"] == pytest.approx(0.3, abs=0.05)
    (gain,) = (f for f in document["findings"] if f["effect"] == "controller_gain")
    assert gain["parameters"]["stiffness_error"]["value"] == pytest.approx(-0.2, abs=0.02)
    assert "Prior: stiffness of swing" in capsys.readouterr().out
    assert "Priors of the servos" in (tmp_path / "out/report.html").read_text()
