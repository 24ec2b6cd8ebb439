"""Known payloads are subtracted from the efforts, and their changes identify the effort scale."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arms import JOINTS, REAL, TRUE, simulated_effort, write_mcap, write_model

from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.measured_recordings import MeasuredRecording, MeasuredRecordings
from pytest_twin.identification.roles import read_by_role
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS, load_twin

TWIN = "model: model.xml\npayloads: {kg3: {lower: {mass: 3, com: [0.4, 0, 0.1]}}}\n"


def identified(folder: Path, scale: list[float], payloads: list[str | None]) -> EffortResult:
    """Result for recordings with these payloads, the last one held out, and scaled efforts."""
    write_model(folder)
    (folder / "real.xml").write_text(TRUE.format(**REAL))
    (folder / "twin.yaml").write_text(TWIN)
    twin = load_twin(folder / "twin.yaml")
    robot = load(folder / "real.xml", twin=twin)
    found = []
    for seed, payload in enumerate(payloads):
        time, q, effort = simulated_effort(robot.variant(payload=payload), seed)
        metadata = {} if payload is None else {"payload": payload}
        found.append(MeasuredRecording(
            folder / f"{seed}.csv", 0.0, JOINTS, time, q, None, effort * np.array(scale),
            np.zeros(2, dtype=bool), np.full(2, np.inf), metadata,
        ))  # fmt: skip
    measured = MeasuredRecordings(tuple(found[:-1]), (found[-1],))
    return identify_effort(load(folder / "model.xml", twin=twin), measured, NO_SIGNALS)


def test_a_known_payload_does_not_change_the_parameters_of_the_robot(tmp_path: Path) -> None:
    result = identified(tmp_path, [1.0, 1.0], ["kg3", "kg3", None])
    values = dict(zip(result.base.expressions, result.fitted.values, strict=True))
    assert values["mx2"] == pytest.approx(0.4, rel=0.05)
    assert max(error.rms for error in result.errors.values()) < 0.1


def test_two_payloads_identify_the_effort_scale_of_each_joint(tmp_path: Path) -> None:
    result = identified(tmp_path, [1.25, 0.9], ["kg3", None, None])
    for joint, true in zip(JOINTS, (1.25, 0.9), strict=True):
        scale = result.scales[joint]
        assert abs(scale.value - true) < scale.half_width
        assert scale.half_width < 0.05
    drive = next(stage for stage in result.stages if stage.name == "drive")
    assert drive.state == "accepted"
    assert {"shoulder.effort_scale", "elbow.effort_scale"} <= set(drive.parameters)
    values = dict(zip(result.base.expressions, result.fitted.values, strict=True))
    assert values["fv1"] == pytest.approx(REAL["damping"], rel=0.05)
    # The scale changes all parameters that were fitted before.
    for name in ("gravity", "inertia", "friction"):
        stage = next(stage for stage in result.stages if stage.name == name)
        assert stage.state == "reopened"
        assert "the scale of the efforts, which known payloads show, moves it beyond" in stage.why
        assert stage.held_out is not None


def test_with_only_one_payload_no_effort_scale_is_identified(tmp_path: Path) -> None:
    assert identified(tmp_path, [1.25, 0.9], ["kg3", "kg3", "kg3"]).scales == {}


def test_a_correct_effort_scale_is_not_significant(tmp_path: Path) -> None:
    result = identified(tmp_path, [1.0, 1.0], ["kg3", None, None])
    assert not any(scale.is_significant for scale in result.scales.values())
    assert result.scales["elbow"].value == pytest.approx(1.0, abs=0.05)
    assert not any(stage.state == "reopened" for stage in result.stages)


def test_a_payload_that_the_twin_does_not_state_is_noted(tmp_path: Path) -> None:
    write_model(tmp_path)
    (tmp_path / "twin.yaml").write_text(TWIN)
    robot = load(tmp_path / "model.xml", twin=load_twin(tmp_path / "twin.yaml"))
    time = np.arange(100) / 100.0
    paths = []
    for size, payload in enumerate(("kg3", "none", "kg5"), start=1):
        moved = 0.3 * size * np.column_stack([np.sin(time), np.cos(time)])
        paths.append(write_mcap(tmp_path / f"{payload}.mcap", time, moved, moved, payload))
    read = read_by_role(paths, [], robot, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS)
    (note,) = (one for one in read.notes if one.startswith("payload"))
    assert note.startswith("payload 'kg5' of kg5.mcap is not under payloads: in twin.yaml")
