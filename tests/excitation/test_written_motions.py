"""Written motions keep all limits; the tests compute this from the written files only."""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from approved_arms import (
    Excited,
    approved_for_arm,
    loaded,
    pairs_in_contact,
    write_drawn,
    write_twin,
)
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from pytest_twin.excitation.excite import excite_file
from pytest_twin.formats.mcap import read_recording
from pytest_twin.strategies import robots

_ROUNDING = 1e-6
MOVING = ("revolute", "continuous", "prismatic")


def read_csv(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    with path.open() as stream:
        rows = list(csv.reader(stream))
    values = np.array(rows[1:], dtype=float)
    joints = [name.removesuffix(".command") for name in rows[0][1:]]
    return values[:, 0], {joint: values[:, at + 1] for at, joint in enumerate(joints)}


def written_files(document: dict[str, Any], out: Path, suffix: str) -> list[Path]:
    return [
        out / name
        for one in document["trajectories"]
        for name in one["files"]
        if name.endswith(suffix)
    ]


def violations(path: Path, section: dict[str, Any]) -> list[str]:
    """Approved limits that the commands of a CSV file violate, by finite differences."""
    time, positions = read_csv(path)
    found = []
    steps = np.diff(time)
    if not np.allclose(steps, 1.0 / section["rate"], rtol=0.0, atol=1e-9):
        found.append("rate")
    if time[-1] > section["duration"] + 1e-9:
        found.append("duration")
    for joint, position in positions.items():
        own = section["joints"][joint]
        velocity = np.diff(position) / steps
        acceleration = np.diff(velocity) / steps[1:]
        low, high = own["position"]
        if position.min() < low - _ROUNDING or position.max() > high + _ROUNDING:
            found.append(f"{joint}: position")
        if np.abs(velocity).max() > own["velocity"] + _ROUNDING:
            found.append(f"{joint}: velocity")
        if np.abs(acceleration).max() > own["acceleration"] + _ROUNDING:
            found.append(f"{joint}: acceleration")
        for end in (0, -1):
            if abs(position[end] - own["start"]) > 1e-9:
                found.append(f"{joint}: does not begin and end at the start")
        for end in (slice(0, 2), slice(-2, None)):
            if np.abs(velocity[end]).max() * section["rate"] > own["acceleration"] + _ROUNDING:
                found.append(f"{joint}: does not begin and end at rest")
    return found


def test_all_motions_of_an_arm_keep_the_limits(excited: Excited) -> None:
    files = written_files(excited.document, excited.folder / "out", ".csv")
    assert len(files) == len(excited.document["trajectories"]) == 16
    assert {file.name: violations(file, approved_for_arm()) for file in files} == {
        file.name: [] for file in files
    }


def test_violations_of_limits_are_found_by_this_check(excited: Excited) -> None:
    section = approved_for_arm()
    for key in ("velocity", "acceleration"):
        section["joints"]["lift"][key] /= 3.0
    file = next(
        f
        for f in written_files(excited.document, excited.folder / "out", ".csv")
        if "fourier" in f.name
    )
    assert {"lift: velocity", "lift: acceleration"} <= set(violations(file, section))


def test_all_file_formats_have_the_same_commands(excited: Excited) -> None:
    out = excited.folder / "out"
    for one in excited.document["trajectories"][:6]:
        table, mcap, trajectory = (out / name for name in one["files"])
        time, positions = read_csv(table)
        series = read_recording(mcap).series["command"]
        assert series.topic == "/joint_commands"
        assert np.allclose(series.stamp * 1e-9, time, rtol=0.0, atol=1e-9)
        points = yaml.load(trajectory.read_text(), yaml.CSafeLoader)
        assert points["joint_names"] == list(positions) == list(series.names)
        stamps = [
            p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"]
            for p in points["points"]
        ]
        assert np.allclose(stamps, time, rtol=0.0, atol=1e-9)
        sent = np.array([p["positions"] for p in points["points"]])
        for at, values in enumerate(positions.values()):
            assert series.position is not None
            assert np.allclose(series.position[:, at], values, rtol=0.0, atol=1e-12)
            assert np.allclose(sent[:, at], values, rtol=0.0, atol=1e-12)
        speed = np.array([p["velocities"] for p in points["points"]])
        differences = np.gradient(sent, time, axis=0)
        assert np.abs(speed - differences)[1:-1].max() < 0.12


def test_mcap_files_state_their_role(excited: Excited) -> None:
    for file in written_files(excited.document, excited.folder / "out", ".mcap"):
        metadata = read_recording(file).metadata
        role = "held_out" if "held_out" in file.name else "fit"
        assert metadata["role"] == role
        assert metadata["command_between"] == "interpolated"


def test_fit_and_held_out_motions_differ(excited: Excited) -> None:
    by_name = {f.stem: f for f in written_files(excited.document, excited.folder / "out", ".csv")}
    for name, file in by_name.items():
        if name.endswith("_fit"):
            other = by_name[name.removesuffix("_fit") + "_held_out"]
            assert file.read_bytes() != other.read_bytes()


def test_the_excitation_is_reproducible_for_a_seed(tmp_path: Path) -> None:
    path = write_twin(tmp_path, approved_for_arm(mechanisms=["delay", "gravity"]))
    texts = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        found = excite_file(str(path), str(tmp_path / name), 3)
        texts.append(
            [f.read_bytes() for f in written_files(found["document"], tmp_path / name, "")]
        )
    assert texts[0] == texts[1]


def test_limits_and_commands_are_in_encoder_coordinates(tmp_path: Path) -> None:
    section = approved_for_arm(mechanisms=["delay", "gravity"])
    path = write_twin(tmp_path, section)
    with path.open("a") as stream:
        stream.write("calibration: {id: c, joints: {lift: {sign: -1, offset: 0.5}}}\n")
    (tmp_path / "out").mkdir()
    found = excite_file(str(path), str(tmp_path / "out"), 1)
    files = written_files(found["document"], tmp_path / "out", ".csv")
    assert len(files) == 6
    assert [violations(file, section) for file in files] == [[]] * 6
    outside = found["abort"]["abort_when"]["joints"]["lift"]["position_outside"]
    assert outside == pytest.approx([-1.2, 1.2])


@settings(
    max_examples=3,
    deadline=None,
    derandomize=True,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(
    robot=robots(links=(2, 4), kinds=MOVING, branching=False, mimics=False, meshes=False),
    seed=st.integers(0, 1000),
)
def test_motions_of_random_robots_keep_limits_and_cause_no_contact(robot: Any, seed: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = write_drawn(Path(name), robot, seed)
        section = yaml.safe_load(path.read_text())["excitation"]
        out = Path(name) / "out"
        out.mkdir()
        document = excite_file(str(path), str(out), seed)["document"]
        assert document["trajectories"]
        realization, _ = loaded(path)
        clearance = section["clearance"]
        # The base and the first link overlap at their joint.
        allowed = {frozenset({"link0", "link1"})}
        if clearance != "none":
            allowed |= {frozenset(pair) for pair in clearance["ignore"]}
        for file in written_files(document, out, ".csv"):
            assert violations(file, section) == [], file.name
            _, positions = read_csv(file)
            few = {joint: values[::5] for joint, values in positions.items()}
            if clearance != "none":
                assert pairs_in_contact(realization, few) <= allowed, file.name
