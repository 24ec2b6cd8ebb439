"""Recordings with the role ``final`` are used only for the final check."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "formats")]

import sensor_bags
from ranges_files import MEANS, make_twin, record_motion, true_arm

from pytest_twin import cli
from pytest_twin.checks.episode import recording_of
from pytest_twin.diagnosis.trials import read_trials
from pytest_twin.errors import RecordingError
from pytest_twin.golden import Golden
from pytest_twin.identification.contact.roles import TossOptions
from pytest_twin.identification.contact.roles import read_by_role as tosses_by_role
from pytest_twin.identification.roles import read_by_role
from pytest_twin.realization import load
from pytest_twin.realization.free_body import FreeBody
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS, load_twin

pytestmark = pytest.mark.usefixtures("commands_in_process")

WORDS = "a final recording only checks ranges: it is not used for {}"


@pytest.fixture
def recordings(tmp_path: Path) -> list[Path]:
    make_twin(tmp_path, [])
    rng, arm = np.random.default_rng(0), true_arm(MEANS)
    return [
        record_motion(tmp_path / f"{name}.mcap", arm, rng, seconds=1.0, role=role)
        for name, role in (("a", "fit"), ("b", "held_out"), ("c", "final"))
    ]


def test_a_diagnosis_leaves_final_recordings_out_with_a_note(recordings: list[Path]) -> None:
    structure = load(recordings[0].parent / "arm.xml").structure
    found = read_trials(recordings, [], DEFAULT_TOPICS, structure)
    assert {t.path.name for t in (*found.fit, *found.held_out)} == {"a.mcap", "b.mcap"}
    (note_text,) = [note for note in found.notes if "c.mcap" in note]
    assert note_text.startswith("left out: ")
    assert WORDS.format("a diagnosis") in note_text
    with pytest.raises(RecordingError, match="a final recording only checks ranges"):
        read_trials(recordings[2:], [], DEFAULT_TOPICS, structure)


def test_an_identification_leaves_final_recordings_out_even_as_held_out(
    recordings: list[Path],
) -> None:
    robot = load(recordings[0].parent / "arm.xml")
    found = read_by_role(
        recordings[:1], recordings[2:], robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS
    )
    assert not found.held_out
    assert any(WORDS.format("an identification") in note for note in found.notes)


def test_a_golden_with_a_final_recording_is_refused(recordings: list[Path]) -> None:
    twin = load_twin(recordings[0].parent / "twin.yaml")
    golden = Golden(
        "golden/replay/final",
        twin.root / "golden" / "final.yaml",
        "replay",
        title="a replay",
        realizations=("mujoco",),
        criticality="critical",
        target={"recording": "c.mcap"},
        stimulus={},
        tolerance={},
    )
    with pytest.raises(RecordingError, match="it is not used for a golden"):
        recording_of(golden, twin)


def test_the_replay_command_accepts_a_final_recording(recordings: list[Path]) -> None:
    folder = recordings[0].parent
    out = str(folder / "predicted.mcap")
    assert cli.main(["replay", str(folder / "twin.yaml"), str(recordings[2]), "--out", out]) == 0


def test_an_error_budget_refuses_final_recordings(
    recordings: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recordings[0].parent
    with (folder / "twin.yaml").open("a") as twin:
        twin.write("budget:\n  recordings: [c.mcap]\n")
    assert cli.main(["budget", str(folder), "--out", str(folder / "budget")]) == 2
    assert WORDS.format("an error budget") in capsys.readouterr().err


def test_a_converted_final_recording_is_still_final(recordings: list[Path]) -> None:
    out = recordings[0].parent / "converted.mcap"
    assert cli.main(["convert", str(recordings[2]), "--out", str(out)]) == 0
    structure = load(out.parent / "arm.xml").structure
    with pytest.raises(RecordingError, match="it is not used for a diagnosis"):
        read_trials([out], [], DEFAULT_TOPICS, structure)


def test_a_contact_identification_refuses_final_recordings(tmp_path: Path) -> None:
    poses = np.tile([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], (5, 1))
    stamps = 10_000_000 * np.arange(5) + 10**18
    toss = sensor_bags.write(
        tmp_path / "toss.mcap", {"/object": (sensor_bags.POSE, stamps, poses)},
        metadata={"role": "final"},
    )  # fmt: skip
    cube = FreeBody("cube", 1, 0, 0, (1,), (0,))
    with pytest.raises(RecordingError, match="it is not used for an identification"):
        tosses_by_role([toss], [], np.array([0.0, 0.0, -9.81]), cube, np.zeros(3), TossOptions())
