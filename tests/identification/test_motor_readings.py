"""Recordings on the motor's side of a gear: replay and the closed loop convert them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_drive_effects import limited, write
from test_identify_simulation import MODEL, NOMINAL

from pytest_twin.errors import RecordingError
from pytest_twin.identification.identify_files import identify_files
from pytest_twin.provenance.poses import poses_of
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.twin import Twin, load_twin

GEAR, ZERO, CONSTANT = -50.0, 0.2, 0.08
"""Gear ratio; position of the joint where the encoder reads 0, rad; torque constant, N*m/A."""
TWIN = f"""\
model: model.xml
command_between: interpolated
signals:
  default:
    gear: {GEAR}
    zero: {ZERO}
    position: {{side: motor, unit: turn}}
    effort: {{quantity: current, side: motor, constant: {CONSTANT}}}
"""


def as_recorded(plain: Path, path: Path) -> Path:
    """Write a recording as the motor's drive logs it: turns and amperes."""
    table = np.loadtxt(plain, delimiter=",", skiprows=1)
    for column in (1, 3):
        table[:, column] = (table[:, column] - ZERO) * GEAR / (2.0 * np.pi)
    table[:, 2] /= GEAR * CONSTANT
    head = "time,swing.position,swing.effort,swing.command"
    np.savetxt(path, table, fmt="%.12g", delimiter=",", header=head, comments="")
    return path


def identified(folder: Path, model: Path, runs: list[Path]) -> dict[str, Any]:
    folder.mkdir()
    return identify_files({
        "model": str(model),
        "recordings": [str(path) for path in runs[:2]],
        "held_out": [str(runs[2])],
        "out": str(folder),
        "name": "out",
    })  # fmt: skip


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twins ``plain`` and ``motor`` of one pendulum, with the same three recordings."""
    folder = tmp_path_factory.mktemp("cell")
    for name, text in (("plain", TWIN.split("signals:")[0]), ("motor", TWIN)):
        (folder / name).mkdir()
        (folder / name / "model.xml").write_text(MODEL.format(**NOMINAL))
        (folder / name / "twin.yaml").write_text(text)
    for seed, name in enumerate(("a.csv", "b.csv", "c.csv"), 1):
        as_recorded(write(folder / "plain" / name, seed, limited(1.0)), folder / "motor" / name)
    return folder


def trials(folder: Path) -> tuple[Twin, Trial]:
    twin = load_twin(folder / "twin.yaml")
    robot = load(folder / "model.xml", twin=twin)
    (recording,) = recordings_at(folder / "a.csv", twin.topics, twin.recordings)
    (trial,) = make_trials(recording, robot.structure, twin.recordings)
    return twin, trial


def test_a_trial_has_the_joint_side_of_states_and_commands(cell: Path) -> None:
    (_, plain), (_, motor) = trials(cell / "plain"), trials(cell / "motor")
    np.testing.assert_allclose(motor.position, plain.position, atol=1e-9)
    np.testing.assert_allclose(motor.command, plain.command, atol=1e-9)
    assert plain.effort is not None
    assert motor.effort is not None
    np.testing.assert_allclose(motor.effort, plain.effort, atol=1e-9)
    assert any("motor position divided by its gear ratio -50" in note for note in motor.notes)


def test_an_effort_that_is_no_torque_is_left_out_of_a_trial(cell: Path) -> None:
    unsigned = TWIN.replace(f"constant: {CONSTANT}", "signed: false")
    assert unsigned != TWIN
    folder = cell / "unsigned"
    shutil.copytree(cell / "motor", folder, ignore=shutil.ignore_patterns("out"))
    (folder / "twin.yaml").write_text(unsigned)
    _, trial = trials(folder)
    assert trial.effort is None
    assert "swing: its effort is no torque, and is not used" in trial.notes


def test_positions_of_a_data_set_are_those_of_the_joint(cell: Path) -> None:
    found = []
    for name in ("plain", "motor"):
        twin, _ = trials(cell / name)
        recordings = recordings_at(cell / name / "a.csv", twin.topics, twin.recordings)
        poses = poses_of(recordings, load(cell / name / "model.xml", twin=twin).structure, twin)
        assert poses is not None
        found.append(poses.positions)
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


@pytest.mark.nightly
def test_an_identification_simulates_the_commands_of_the_motor(cell: Path) -> None:
    plain, motor = (
        identified(cell / name / "out", cell / name / "twin.yaml",
                   [cell / name / f"{n}.csv" for n in "abc"])
        for name in ("plain", "motor")
    )  # fmt: skip
    error, expected = motor["held_out"]["swing"], plain["held_out"]["swing"]
    assert expected["position_rms"] < 0.05 * expected["position_rms_nominal"]
    for name in ("position_rms_nominal", "position_rms", "effort_rms"):
        assert error[name] == pytest.approx(expected[name], rel=0.02)
    assert "swing.torque_saturation.inverse_limit" in motor["parameters"]


def test_a_servo_on_the_side_of_the_motor_has_its_gains_at_the_joint(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    (tmp_path / "twin.yaml").write_text(TWIN)
    runs = [
        as_recorded(write(tmp_path / "p.csv", seed, lambda effort, _: effort),
                    tmp_path / f"{seed}.csv")
        for seed in (1, 2, 3)
    ]  # fmt: skip
    document = identified(tmp_path / "out", tmp_path / "twin.yaml", runs)
    assert document["parameters"]["swing.servo_stiffness"]["value"] == pytest.approx(8.0, rel=0.01)


@pytest.mark.parametrize(
    ("signals", "words"),
    [
        ({"effort": {"quantity": "current"}}, "the commanded effort of joint 'swing' is no torque"),
        (
            {"position": {"side": "motor"}, "shared_with": {"joint": "wrist"}},
            "swing: its motor is also turned by wrist, which is not in the messages",
        ),
    ],
)
def test_what_cannot_be_converted_is_an_error(
    tmp_path: Path, signals: dict[str, Any], words: str
) -> None:
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    (tmp_path / "twin.yaml").write_text(json.dumps(
        {"model": "model.xml", "command_mode": "effort", "signals": {"default": signals}}
    ))  # fmt: skip
    rows = np.column_stack([np.arange(60) * 0.01, *np.random.default_rng(0).normal(size=(2, 60))])
    head = "time,swing.position,swing.command"
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=head, comments="")
    with pytest.raises(RecordingError) as raised:
        trials(tmp_path)
    assert words in str(raised.value)


def test_an_identification_needs_the_joint_that_also_turns_a_motor(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(MODEL.format(**NOMINAL))
    other = TWIN.replace("    gear:", "    shared_with: {joint: wrist}\n    gear:")
    (tmp_path / "twin.yaml").write_text(other)
    run = as_recorded(write(tmp_path / "p.csv", 1, limited(1.0)), tmp_path / "a.csv")
    with pytest.raises(RecordingError, match="its motor is also turned by wrist, which is not in"):
        identified(tmp_path / "out", tmp_path / "twin.yaml", [run, run, run])


def test_options_of_recordings_keep_the_signals(cell: Path) -> None:
    options = load_twin(cell / "motor/twin.yaml").recordings
    assert options.signals.of("swing").gear == GEAR
    assert NO_OPTIONS.over(options) == options
    assert RecordingOptions.from_json(options.to_json()) == options
