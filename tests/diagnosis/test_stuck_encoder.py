"""Findings at a joint whose encoder is stuck have a low confidence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from test_simulation_settings import ARM, STEP, recorded

from pytest_twin.diagnosis.diagnose import diagnose
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.loaded_model import load_model

NAMES = ("shoulder", "elbow")
HIDDEN = 3.0
"""Additional viscous friction of the elbow, N*m*s/rad: an error of 6 floors at the shoulder."""


def with_stuck_elbow(path: Path, role: str) -> Path:
    """The same recording, with an elbow encoder that reads its first position throughout."""
    series = read_recording(path).series
    state, command = series["state"], series["command"]
    assert state.position is not None
    assert command.position is not None
    stuck = np.stack([state.position[:, 0], np.full(len(state.stamp), 0.0)], axis=1)
    out = path.with_name(f"stuck_{path.name}")
    write_recording(
        out,
        [
            JointSeries("/joint_states", NAMES, state.stamp, state.stamp, stuck, None, None),
            JointSeries("/joint_commands", NAMES, command.stamp, command.stamp, command.position,
                        None, None),
        ],
        {"role": role},
    )  # fmt: skip
    return out


def test_a_finding_at_a_joint_with_a_stuck_encoder_has_at_most_half_confidence(
    tmp_path: Path,
) -> None:
    (tmp_path / "model.xml").write_text(ARM.format(step=STEP, damping=0.3))
    loaded = load_model(tmp_path / "model.xml")
    files = [
        with_stuck_elbow(recorded(tmp_path, k, role, substeps=20, damping=0.3 + HIDDEN), role)
        for k, role in ((1, "fit"), (2, "held_out"))
    ]
    trials = read_trials(files, (), loaded.topics, loaded.realization.structure)
    found = diagnose(loaded.realization, trials, threads=1)
    assert set(found.errors) == {"shoulder"}
    at_elbow = [f for f in found.explanation.findings if f.joint == "elbow"]
    assert [f.effect for f in at_elbow] == ["viscous_friction"]
    assert all(f.confidence <= 0.5 for f in at_elbow)
    estimate = at_elbow[0].parameters["coefficient"]
    assert estimate.low < HIDDEN < estimate.high
    notes = [n for n in found.notes if "the encoder of this joint gives no information" in n]
    assert len(notes) == len(at_elbow)
    assert not any("shoulder" in n for n in notes)
