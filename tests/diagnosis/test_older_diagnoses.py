"""A diagnosis of `examples/carriage` as version 0.1 wrote it (`written_by_0_1/`)."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pytest_twin import load_model, read_trials, replay
from pytest_twin.cli import main

pytestmark = pytest.mark.usefixtures("commands_in_process")
HERE = Path(__file__).parent
RECORDING = HERE.parents[1] / "examples" / "carriage" / "recordings" / "moves.csv"


@pytest.fixture
def diagnosis(tmp_path: Path) -> Path:
    return shutil.copytree(HERE / "written_by_0_1" / "why", tmp_path / "why")


def test_the_model_of_an_older_diagnosis_is_replayed_with_its_effects(diagnosis: Path) -> None:
    model = load_model(diagnosis)
    [trial] = read_trials(model, RECORDING)
    [predicted] = replay(model, [trial])
    stated = json.loads((diagnosis / "diagnosis.json").read_text())["held_out"]["slide"]
    error_rms = np.sqrt(np.mean((predicted.position - trial.position) ** 2))
    assert error_rms == pytest.approx(stated["rms_after"], rel=0.05)
    assert error_rms < 0.01 * stated["rms_before"]


def test_an_older_diagnosis_is_exported(diagnosis: Path, tmp_path: Path) -> None:
    out = tmp_path / "exported"
    arguments = ["export", str(diagnosis), "--to", "mujoco", "--out", str(out)]
    assert main([*arguments, "--held-out", str(RECORDING)]) == 0
    document = json.loads((out / "export.json").read_text())
    rows = {row["feature"]: (row["verdict"], row["before"]) for row in document["rows"]}
    assert rows["viscous_friction of slide"] == ("kept", "coefficient 84.8979 N*s/m")
    assert rows["coulomb_friction of slide"] == ("kept", "coulomb 14.0116 N")
    assert document["held_out"]["slide"]["rms_exported"] == pytest.approx(8.3e-6, rel=0.05)
