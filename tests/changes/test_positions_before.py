"""``diagnose --before``: what changed between recordings without efforts, by simulation."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from pytest_twin.changes import by_simulation
from pytest_twin.cli import main
from pytest_twin.diagnosis.conclusion import ChosenModel
from pytest_twin.diagnosis.search_recordings import find_structure
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.formats.recording import TOPICS
from pytest_twin.realization import Realization
from pytest_twin.trial import recordings_at

sys.path.append(str(Path(__file__).parents[1] / "diagnosis"))
import touching_arm
from two_pendulums import DECLARED, mjcf, record, write

pytestmark = pytest.mark.usefixtures("commands_in_process")
JOINTS = ("left",)
TOUCHING = ("shoulder",)
WRONG = {"viscous": 0.02, "dry": 0.03}
"""What the model lacks in all recordings."""
MAGNET = {"magnet": 0.06}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a model without dry friction, and recordings of the pendulum before."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "model.xml").write_text(mjcf(JOINTS))
    for seed in range(4):
        record(folder / f"old{seed}.mcap", seed, seconds=2.0, joints=JOINTS, **WRONG)
    return folder


def new_recording(folder: Path, **hidden: float) -> Path:
    return record(folder / "new.mcap", 20, seconds=2.0, joints=JOINTS, **(WRONG | hidden))


def compare(
    robot: Path, out: Path, *new: Path, seconds: str = "0", held_out: Sequence[Path] = ()
) -> tuple[int, dict[str, Any]]:
    earlier = [str(robot / f"old{seed}.mcap") for seed in range(4)]
    status = main([
        "diagnose", str(robot / "model.xml"), *map(str, new), "--before", *earlier,
        *(["--held-out", *map(str, held_out)] if held_out else []),
        "--out", str(out), "--seconds", seconds,
    ])  # fmt: skip
    document = json.loads((out / "diagnosis.json").read_text()) if status < 2 else {}
    return status, document


def test_unchanged_positions_are_no_change_although_the_model_is_wrong(
    robot: Path, tmp_path: Path
) -> None:
    """What the metadata declare is named as declared."""
    warm = {**DECLARED, "temperature": "31.20000001", "tool": "gripper B"}
    new = record(
        tmp_path / "new.mcap", 20, seconds=2.0, joints=JOINTS, metadata=warm, **WRONG
    )  # fmt: skip
    status, document = compare(robot, tmp_path / "out", new)
    assert (status, document["verdict"], document["findings"]) == (0, "no_change", [])
    assert document["by"] == "simulation"
    assert document["declared"] == [
        {"what": "tool", "before": ["none"], "now": ["gripper B"], "in_model": False},
        {"what": "temperature", "before": ["none"], "now": ["31.20000001"], "in_model": False},
    ]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Declared: tool none before, gripper B now" in page
    assert "Declared: temperature none before, 31.2 now" in page


def test_more_dry_friction_is_named_with_the_value_before(robot: Path, tmp_path: Path) -> None:
    status, document = compare(robot, tmp_path / "out", new_recording(tmp_path, dry=0.08))
    assert (status, document["verdict"]) == (1, "changed")
    (finding,) = document["findings"]
    assert (finding["effect"], finding["joint"]) == ("coulomb_friction", "left")
    assert finding["confidence"] == 0.9
    low, high = finding["change"]["coulomb"]["ci95"]
    assert low < 0.05 < high
    assert finding["known_before"]["coulomb"]["value"] == pytest.approx(0.03, abs=0.002)
    assert finding["parameters"]["coulomb"]["value"] == pytest.approx(0.08, abs=0.004)
    assert finding["held_out_gain"] is None
    assert document["repeated"] == []
    # The written model has 0.08 N*m; without the change it is the one that the robot had.
    undone = document["counterfactual"]
    assert undone["holds"]
    errors = undone["joints"]["left"]
    assert errors["rms_undone"] == pytest.approx(errors["rms_known"], rel=0.05)
    assert errors["rms_changed"] > 3.0 * errors["rms_known"]
    written = (tmp_path / "out" / "realization" / "model.xml").read_text()
    assert float(written.split('frictionloss="')[1].split('"')[0]) == pytest.approx(0.08, abs=0.004)
    error, new = document["position"]["left"], finding["difference"]
    assert error["unit"] == "rad"
    # Both are errors of single samples: with the change the robot is predicted as before.
    assert error["rms_after"] == pytest.approx(error["rms_usual"], rel=0.2)
    measured, change = np.array(new["measured"]), np.array(new["change"])
    assert np.std(measured - change) < 0.2 * np.std(measured)
    assert "Coulomb friction" in (tmp_path / "out" / "report.html").read_text()


def test_a_held_out_recording_tests_the_change_and_is_not_fitted(
    robot: Path, tmp_path: Path
) -> None:
    other = WRONG | {"dry": 0.12}
    held_out = record(tmp_path / "held_out.mcap", 21, seconds=2.0, joints=JOINTS, **other)
    new = new_recording(tmp_path, dry=0.08)
    _, document = compare(robot, tmp_path / "out", new, held_out=[held_out])
    (finding,) = document["findings"]
    assert finding["parameters"]["coulomb"]["value"] == pytest.approx(0.08, abs=0.004)
    assert 0.2 < finding["held_out_gain"] < 0.95


@pytest.mark.nightly
def test_in_a_repeated_motion_an_error_of_the_model_is_no_background(
    robot: Path, tmp_path: Path
) -> None:
    """A magnet is in no law of the catalogue. What the model leaves is subtracted."""
    for seed in range(4):
        record(tmp_path / f"old{seed}.mcap", seed, seconds=2.0, joints=JOINTS, **MAGNET)
    (tmp_path / "model.xml").write_text((robot / "model.xml").read_text())
    # Another seed of the noise, the same commands.
    again = record(tmp_path / "again.mcap", 1, seconds=2.0, joints=JOINTS, noise=1.1e-4,
                   **(MAGNET | {"dry": 0.12}))  # fmt: skip
    _, document = compare(tmp_path, tmp_path / "out", again)
    (motion,) = document["repeated"]
    assert (motion["new"], motion["before"]) == ("again.mcap", ["old1.mcap"])
    difference = motion["difference"]["left"]
    assert difference["rms_after"] < 0.2 * difference["rms"]
    residual = document["position"]["left"]
    assert difference["rms_after"] < 0.5 * residual["rms_usual"]
    change = document["findings"][0]["change"]["coulomb"]
    assert change["value"] == pytest.approx(0.12, rel=0.05)
    assert (document["findings"][0]["effect"], document["findings"][0]["joint"]) == (
        "coulomb_friction", "left",
    )  # fmt: skip
    assert "again.mcap repeats old1.mcap" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.nightly
def test_a_later_command_is_a_delay_of_commands_or_readings(robot: Path, tmp_path: Path) -> None:
    _, document = compare(robot, tmp_path / "out", new_recording(tmp_path, delay=0.012))
    (finding,) = document["findings"]
    assert finding["effect"] in ("command_delay", "sensor_delay")
    assert finding["change"]["delay"]["value"] == pytest.approx(0.012, abs=0.002)
    # Positions alone do not tell a late command from a late reading.
    assert finding["confidence"] < 0.6
    assert "Changed: could be " in (tmp_path / "out" / "report.html").read_text()


def test_at_the_time_limit_the_best_answer_is_given(robot: Path, tmp_path: Path) -> None:
    status, document = compare(
        robot, tmp_path / "out", new_recording(tmp_path, dry=0.08), seconds="0.1"
    )
    assert (status, document["verdict"]) in ((1, "changed"), (1, "changed_unnamed"))
    assert any("the search ended early" in note for note in document["notes"])
    assert all(finding["confidence"] <= 0.5 for finding in document["findings"])


def test_a_change_is_not_sure_where_the_earlier_search_did_not_end(
    robot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the model lacked before, and was not found, may pass for a change."""

    def stopped(realization: Realization, trials: TrialSet, **options: Any) -> ChosenModel:
        found = find_structure(realization, trials, **options)
        if not trials.earlier:
            options["run"].skip("the search for further effects")
        return found

    monkeypatch.setattr(by_simulation, "find_structure", stopped)
    _, document = compare(robot, tmp_path / "out", new_recording(tmp_path, dry=0.08))
    (finding,) = document["findings"]
    assert (finding["effect"], finding["confidence"]) == ("coulomb_friction", 0.5)
    assert any("may pass for a change" in note for note in document["notes"])


def test_a_copy_of_an_earlier_recording_is_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied = tmp_path / "renamed.mcap"
    copied.write_bytes((robot / "old2.mcap").read_bytes())
    assert compare(robot, tmp_path / "out", copied)[0] == 2
    assert "the same recording is given with --before, as old2.mcap" in capsys.readouterr().err


def test_a_part_of_an_earlier_recording_saved_as_csv_is_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording,) = recordings_at(robot / "old2.mcap", TOPICS)
    states, commands = (recording.series[role] for role in ("state", "command"))
    assert states.position is not None
    assert commands.position is not None
    sent = commands.position[np.searchsorted(commands.stamp, states.stamp, side="right") - 1]
    rows = np.column_stack([states.stamp * 1e-9, states.position, sent])[100:]
    head = "time,left.position,left.command"
    copied = tmp_path / "part.csv"
    np.savetxt(copied, rows, fmt="%.6f", delimiter=",", header=head, comments="")
    assert compare(robot, tmp_path / "out", copied)[0] == 2
    assert "the same recording is given with --before, as old2.mcap" in capsys.readouterr().err


def record_touch(path: Path, seed: int, offset: float = 0.0, states: int = 2) -> Path:
    """A recording of 1.4 s of an arm that hits a table, offset in m above the model's.

    Args:
        states: number of states for each command; commands have 100 Hz.
    """
    text = touching_arm.mjcf(TOUCHING, step=touching_arm.FINE, offset=offset, damping=0.15)
    arm = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(arm)
    period, count = 0.01 / states, 140 * states
    each = round(period / touching_arm.FINE)
    sent_at, seen_at = 0.01 * np.arange(140), period * np.arange(count)
    sent = touching_arm.commands(seed, sent_at, 1)
    moved = []
    for command in sent.repeat(states, axis=0):
        moved.append(data.qpos.copy())
        data.ctrl[:] = command
        mujoco.mj_step(arm, data, each)
    seen = np.array(moved) + 1e-4 * np.random.default_rng([seed, 1]).standard_normal((count, 1))
    write(path, TOUCHING, sent_at, sent, seen_at, seen, None, metadata=DECLARED)
    return path


# At 100 Hz there are two blocks of independent samples, and the arm hits the table in one of them.
@pytest.mark.parametrize(("offset", "states"), [(0.0, 2), (0.006, 2), (0.0, 1), (0.006, 1)])
def test_a_surface_that_moved_is_found_with_its_offset(
    tmp_path: Path, offset: float, states: int
) -> None:
    (tmp_path / "model.xml").write_text(touching_arm.mjcf(TOUCHING))
    for seed in range(4):
        record_touch(tmp_path / f"old{seed}.mcap", seed, states=states)
    new = record_touch(tmp_path / "new.mcap", 20, offset, states)
    status, document = compare(tmp_path, tmp_path / "out", new)
    names = [(finding["effect"], finding["joint"]) for finding in document["findings"]]
    assert (status, names) == ((1, [("contact_offset", None)]) if offset else (0, []))
    for finding in document["findings"]:
        low, high = finding["change"]["offset"]["ci95"]
        assert low < offset < high
        # Against a table, a shifted encoder of the only joint looks alike.
        others = {other["effect"] for other in finding["alternatives"]}
        assert finding["confidence"] > 0.9 or "encoder_bias" in others


def test_an_undeclared_payload_is_refused(
    robot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loaded = record(
        tmp_path / "new.mcap", 20, seconds=2.0, joints=JOINTS,
        metadata={**DECLARED, "payload": "box"}, **WRONG,
    )  # fmt: skip
    assert compare(robot, tmp_path / "out", loaded)[0] == 2
    error = capsys.readouterr().err
    assert "its payload differs" in error
    assert "payloads: in twin.yaml" in error
