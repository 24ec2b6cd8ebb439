"""Friction that depends on temperature, from trials with a temperature in their metadata."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from two_pendulums import DECLARED, mjcf, record

from pytest_twin import cli
from pytest_twin.diagnosis.patched.model import read_effects
from pytest_twin.diagnosis.temperature import cold_fraction_of_trial, cold_fractions_of
from pytest_twin.errors import RecordingError, SpecError
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import Trial, make_trial
from pytest_twin.twin import EFFECTS_FILE

pytestmark = pytest.mark.usefixtures("commands_in_process")

EXCESS = 0.1


def diagnosed(folder: Path, hidden: str, excess: float) -> Path:
    """Diagnose cold trials with additional friction at the left joint, and warm ones without it."""
    (folder / "model.xml").write_text(mjcf())
    files = [
        record(
            folder / f"{role}_{name}{seed}.mcap", seed, role=role, seconds=1.0,
            metadata=DECLARED | {"temperature": name}, **{hidden: level, "joint": 0},
        )
        for seed, (role, name, level) in enumerate(
            (role, name, level)
            for role in ("fit", "fit", "held_out")
            for name, level in (("cold", excess), ("warm", 0.0))
        )
    ]  # fmt: skip
    words = ["diagnose", "--seconds", "0", str(folder / "model.xml"), *map(str, files)]
    assert cli.main([*words, "--out", str(folder / "out")]) == 0
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return diagnosed(tmp_path_factory.mktemp("cold"), "dry", EXCESS)


def read_diagnosis(folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / "out" / "diagnosis.json").read_text())
    return loaded


def test_dry_friction_in_cold_trials_only_is_found_as_temperature_dependent_friction(
    folder: Path,
) -> None:
    """One friction level for all trials would be wrong in each of them."""
    found = read_diagnosis(folder)
    (finding,) = found["findings"]
    assert (found["verdict"], finding["effect"], finding["joint"]) == (
        "explained", "thermal_friction", "left",
    )  # fmt: skip
    assert finding["parameters"]["excess"]["value"] == pytest.approx(EXCESS, rel=0.03)
    low, high = finding["parameters"]["excess"]["ci95"]
    assert low <= EXCESS <= high
    assert finding["confidence"] > 0.9
    assert finding["where"]["summary"].startswith("temperature cold (")
    assert all("cold" in name for name in finding["where"]["windows"])


@pytest.mark.nightly
def test_viscous_friction_in_cold_trials_only_is_found_as_temperature_dependent_friction(
    tmp_path: Path,
) -> None:
    (finding,) = read_diagnosis(diagnosed(tmp_path, "viscous", 0.2))["findings"]
    assert (finding["effect"], finding["joint"]) == ("thermal_friction", "left")
    low, high = finding["parameters"]["viscous_excess"]["ci95"]
    assert low <= 0.2 <= high
    assert finding["parameters"]["viscous_excess"]["value"] == pytest.approx(0.2, rel=0.03)


def test_a_patched_model_is_replayed_at_the_temperature_of_the_recording(folder: Path) -> None:
    for name, seed in (("cold", 4), ("warm", 5)):
        recording = folder / f"held_out_{name}{seed}.mcap"
        out = folder / f"{name}.mcap"
        assert cli.main(["replay", str(folder / "out"), str(recording), "--out", str(out)]) == 0
        predicted, measured = (read_recording(p).series["state"].position for p in (out, recording))
        assert predicted is not None
        assert measured is not None
        error = read_diagnosis(folder)["held_out"]["left"]
        rms = float(np.sqrt(np.mean((predicted - measured)[:, 0] ** 2)))
        assert rms < 2.0 * error["floor"] < 0.1 * error["rms_before"]


def test_a_replay_without_temperature_is_refused_and_the_known_temperatures_are_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = record(folder / "silent.mcap", 9)
    words = ["replay", str(folder / "out"), str(silent), "--out", str(folder / "no.mcap")]
    assert cli.main(words) == 2
    text = capsys.readouterr().err
    assert "silent.mcap" in text
    assert "the model's friction depends on temperature" in text
    assert "like cold, warm" in text
    assert not (folder / "no.mcap").exists()


@pytest.mark.parametrize(
    ("cold_fraction", "expected"),
    [({"cold": "very"}, "a finite number"), ([1.0], "a table"),
     ({"a": 0.5, "b": 0.5}, "temperatures that differ")],
    ids=["text instead of a number", "list instead of a table", "equal fractions"],
)  # fmt: skip
def test_invalid_temperatures_in_the_effects_file_are_refused(
    folder: Path, tmp_path: Path, cold_fraction: object, expected: str
) -> None:
    listed = json.loads((folder / "out" / "realization" / EFFECTS_FILE).read_text())
    assert listed["coldness"] == {"cold": 1.0, "warm": 0.0}
    path = tmp_path / EFFECTS_FILE
    path.write_text(json.dumps({**listed, "coldness": cold_fraction}))
    with pytest.raises(SpecError, match=expected):
        read_effects(path)


def trial(tmp_path: Path, name: str, temperature: str | None) -> Trial:
    (tmp_path / "model.xml").write_text(mjcf())
    metadata = None if temperature is None else {"temperature": temperature}
    path = record(tmp_path / name, 0, seconds=0.3, metadata=metadata)
    return make_trial(
        read_recording(path), load_model(tmp_path / "model.xml").realization.structure
    )


@pytest.mark.parametrize(
    ("names", "cold_fraction"),
    [
        (["20", "-5", "45"], {"-5": 1.0, "20": 0.5, "45": 0.0}),
        (["20 C", "40 °C"], {"20 C": 1.0, "40 °C": 0.0}),
        (["293.15 K", "283.15 K"], {"283.15 K": 1.0, "293.15 K": 0.0}),
        (["warm", "cold"], {"cold": 1.0, "warm": 0.0}),
        # Three names, two units, equal or missing temperatures have no order.
        (["a", "b", "c"], {}),
        (["20 C", "300 K", "40 C"], {}),
        (["20", "20.0"], {}),
        (["20", None], {}),
        ([None, None], {}),
    ],
    ids=[
        "numbers",
        "degrees Celsius",
        "kelvin",
        "two names",
        "three names",
        "two units",
        "equal",
        "one missing",
        "all missing",
    ],
)
def test_cold_fractions_are_known_for_numbers_of_one_unit_and_for_two_names(
    tmp_path: Path, names: list[str | None], cold_fraction: dict[str, float]
) -> None:
    trials = [trial(tmp_path, f"{i}.mcap", name) for i, name in enumerate(names)]
    assert cold_fractions_of(trials) == pytest.approx(cold_fraction)


def test_the_cold_fraction_is_linear_in_temperature_and_not_negative(tmp_path: Path) -> None:
    known = {"20 C": 1.0, "40 C": 0.0}
    for name, share in (("25 C", 0.75), ("10 C", 1.5), ("60 C", 0.0), ("40 C", 0.0)):
        assert cold_fraction_of_trial(known, trial(tmp_path, "t.mcap", name)) == pytest.approx(
            share
        )
    with pytest.raises(RecordingError, match="like 20 C, 40 C"):
        cold_fraction_of_trial(known, trial(tmp_path, "t.mcap", "lukewarm"))
    assert cold_fraction_of_trial({}, trial(tmp_path, "t.mcap", None)) == 1.0
