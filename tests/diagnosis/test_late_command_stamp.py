"""An error of one microsecond in a time stamp does not change the diagnosis."""

from __future__ import annotations

from pathlib import Path

import pytest
from recorded_pendulum import MODEL, SERVO, Reality, record

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.loaded_model import find_model, load_model

EFFORTS = Reality(command_period=0.01, effort="measured", velocity="sensor")


def diagnosed(folder: Path, reality: Reality, late_ns: int) -> Diagnosis:
    folder.mkdir()
    model = folder / "model.xml"
    model.write_text(MODEL.format(actuator=SERVO), "utf-8")
    recordings = [
        record(folder / f"r{seed}.mcap", seed, reality, seconds=2.5, late_stamp_ns=late_ns)
        for seed in (2, 3)
    ]
    loaded = load_model(find_model(model))
    trials = read_trials(recordings, [], loaded.topics, loaded.realization.structure)
    return diagnose(loaded.realization, trials, threads=1)


@pytest.mark.parametrize("late_ns", [0, 1_000], ids=["on time", "one microsecond late"])
def test_a_command_stamp_that_is_one_microsecond_late_causes_no_finding(
    tmp_path: Path, late_ns: int
) -> None:
    found = diagnosed(tmp_path / "cell", EFFORTS, late_ns)
    assert found.verdict == "no_mismatch", found.errors
    assert found.explanation.findings == ()
