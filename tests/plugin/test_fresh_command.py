"""``pytest-twin fresh``: changes of the twin since data were stamped, and their effect on the tool.

The arm is planar: a change d (rad) of the elbow zero displaces the tool, 0.25 m away, by
2 * 0.25 m * sin(d / 2) in every pose.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.commands import fresh as command
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.formats.schema import load_schema

sys.path.append(str(Path(__file__).parents[1]))

from in_process import InProcess

JOINTS = ("shoulder", "elbow")


@pytest.fixture
def data(released) -> Path:
    return stamped_wave(released, 1e-3)


def stamped_wave(released, error: float, joints: tuple[str, ...] = JOINTS, *options: str) -> Path:
    """A recording of a slow sine motion, stamped with release 1; states differ by an error, rad."""
    time = np.arange(0.0, 2.0, 0.01)
    stamps = np.rint(1e9 * time).astype(np.int64) + 10**18
    wave = np.column_stack([0.4 * np.sin(3 * time), 0.8 * np.cos(2 * time)])
    series = [
        JointSeries("/joint_states", joints, stamps, stamps, wave + error, None, None),
        JointSeries("/joint_commands", joints, stamps, stamps, wave, None, None),
    ]
    path = released.root.parent / "wave.mcap"
    write_recording(path, series, {"controller": "soft"})
    assert cli.main(["stamp", str(path), "--release", str(released.root), *options]) == 0
    return path


def fresh(data: Path, status: int) -> dict:
    out = data.parent / "fresh.json"
    assert cli.main(["fresh", str(data), "--json", str(out)]) == status
    document = json.loads(out.read_text())
    jsonschema.validate(document, load_schema("results/fresh.schema.json"))
    return document


@pytest.fixture(autouse=True)
def in_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run without a child process to save time, except in one test."""
    if request.function is not test_data_of_an_unchanged_twin_are_fresh:
        monkeypatch.setattr(command, "Sandbox", InProcess)


def test_data_of_an_unchanged_twin_are_fresh(released, data: Path) -> None:
    document = fresh(data, 0)
    assert document["changes"] == []
    assert document["release"] == document["newest"] == 1


def test_a_changed_joint_zero_is_reported_by_the_displacement_of_the_tool(
    released, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = "calibration: {id: after the fall, joints: {elbow: {offset: 0.3}}}\n"
    released.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{calibration}")
    document = fresh(data, 1)
    (change,) = document["changes"]
    assert change["part"] == "calibration:elbow"
    expected = 0.5 * math.sin(0.15)
    assert change["size"]["translation"] == pytest.approx(expected, rel=1e-9)
    assert change["size"]["translation_rms"] == pytest.approx(expected, rel=1e-9)
    assert change["size"]["rotation"] == pytest.approx(0.3, rel=1e-9)
    said = capsys.readouterr().out
    assert "the zero of joint 'elbow' moved by 0.3 rad: 'tcp' moves by up to 74.7 mm" in said
    assert "over this data's poses (200 of them)" in said


def test_a_change_below_the_threshold_is_listed_and_the_data_stay_fresh(
    released, data: Path
) -> None:
    calibration = "calibration: {id: again, joints: {elbow: {offset: 0.001}}}\n"
    released.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{calibration}")
    document = fresh(data, 0)
    assert [one["matters"] for one in document["changes"]] == [False]
    released.edit("twin.yaml", calibration, f"{calibration}fresh: {{translation: 0.0002}}\n")
    assert fresh(data, 1)["moved"]["translation"] == pytest.approx(0.00025, rel=1e-5)


def test_a_renamed_joint_that_the_data_name_makes_them_stale(released, data: Path) -> None:
    for file in ("arm.xml", "twin.yaml"):
        text = (released.root / file).read_text()
        (released.root / file).write_text(text.replace("elbow", "elbow_joint"))
    document = fresh(data, 1)
    lost = {one["part"]: one for one in document["changes"]}["mujoco/joint:elbow"]
    assert lost["matters"]
    assert lost["why"] == "the data may use this joint, and only one version has it"


def test_data_with_other_joint_names_are_compared_by_the_mapping_of_their_stamp(released) -> None:
    path = stamped_wave(released, 1e-3, ("j1", "j2"), "--joints", "j1=shoulder,j2=elbow")
    calibration = "calibration: {id: after the fall, joints: {elbow: {offset: 0.3}}}\n"
    released.edit("twin.yaml", "tcp: tcp\n", f"tcp: tcp\n{calibration}")
    document = fresh(path, 1)
    assert document["poses"]["count"] == 200
    assert document["moved"]["translation"] == pytest.approx(0.5 * math.sin(0.15), rel=1e-9)


def test_positions_far_beyond_the_released_ranges_are_noted(released) -> None:
    """Another robot may have joints of the same names."""
    assert fresh(stamped_wave(released, 0.0), 0)["notes"] == []
    notes = fresh(stamped_wave(released, 40.0), 0)["notes"]
    assert [note.partition(":")[0] for note in notes] == list(JOINTS)
    assert all("100 % of the recorded positions lie far beyond" in note for note in notes)


def test_data_whose_actions_were_made_from_states_are_judged_by_the_actions(released) -> None:
    """Nothing that was measured is compared: both versions follow the same actions."""
    copies = stamped_wave(released, 0.0)
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.600001"')
    document = fresh(copies, 0)
    (change,) = document["changes"]
    assert "under this data's commands the simulated joint" in change["why"]
    released.edit("arm.xml", 'mass="0.600001"', 'mass="6.0"')
    (change,) = fresh(copies, 1)["changes"]
    assert change["size"]["position"] > 0.01


def test_changed_tool_length_and_link_mass_are_each_reported_with_their_effect(
    released, data: Path
) -> None:
    released.edit(
        "arm.xml", '<site name="tcp" pos="0.25 0 0"/>', '<site name="tcp" pos="0.27 0 0"/>'
    )
    document = fresh(data, 1)
    (change,) = document["changes"]
    assert change["part"].endswith("frame:tcp")
    assert change["size"]["translation"] == pytest.approx(0.02, rel=1e-9)
    assert change["size"]["rotation"] < 1e-9
    released.edit("arm.xml", 'mass="0.6"', 'mass="0.9"')
    by_part = {one["part"].partition("/")[2]: one for one in fresh(data, 1)["changes"]}
    heavier = by_part["inertia:fore"]
    assert heavier["matters"]
    assert "the simulated joint" in heavier["why"]
    # The shoulder servo (40 N*m/rad) deflects under the added 0.3 kg at up to 0.4 m.
    assert 0.01 < heavier["size"]["position"] < 0.3 * 9.81 * 0.4 / 20 * 2


def test_only_the_controller_that_the_data_name_matters(released, data: Path) -> None:
    released.edit("twin.yaml", "tcp: tcp\n", "tcp: tcp\ncontrollers: {stiff: {elbow: {kp: 50}}}\n")
    by_part = {one["part"]: one for one in fresh(data, 0)["changes"]}
    assert not by_part["controller:stiff"]["matters"]
    released.edit("twin.yaml", "stiff:", "soft: {elbow: {kp: 2}}, stiff:")
    by_part = {one["part"]: one for one in fresh(data, 1)["changes"]}
    assert by_part["controller:soft"]["matters"]
    assert by_part["controller:soft"]["size"]["joint"] == "elbow"


def test_changes_for_a_policy_are_evaluated_over_the_joint_ranges(released) -> None:
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 2]) for n in "xy"]
    node = helper.make_node("Identity", ["x"], ["y"])
    path = released.root / "policy.onnx"
    onnx.save(helper.make_model(helper.make_graph([node], "p", ends[:1], ends[1:])), path)
    assert cli.main(["stamp", str(path), "--release", str(released.root)]) == 0
    released.edit("arm.xml", 'name="fore" pos="0.3 0 0"', 'name="fore" pos="0.31 0 0"')
    document = fresh(path, 1)
    assert document["poses"]["source"].endswith("drawn within the joints' ranges")
    assert document["moved"]["translation"] == pytest.approx(0.01, rel=1e-9)


def test_a_changed_release_or_unstamped_data_is_refused_in_one_line_with_exit_status_2(
    released, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (released.root / "releases" / "0001" / "files" / "arm.xml").write_text("<mujoco/>")
    assert cli.main(["fresh", str(data)]) == 2
    assert "not the file that was signed" in capsys.readouterr().err
    bare = data.with_name("bare.mcap")
    stamps = np.array([10**18, 10**18 + 10**7])
    write_recording(
        bare, [JointSeries("/joint_states", JOINTS, stamps, stamps, np.zeros((2, 2)), None, None)]
    )
    assert cli.main(["fresh", str(bare)]) == 2
    assert "is not stamped" in capsys.readouterr().err


USER_TEST = """
import mujoco

def test_it(twin_release):
    assert twin_release.twin == "arm"
    assert twin_release.number == 1
    model = mujoco.MjModel.from_xml_path(str(twin_release.file("arm.xml")))
    assert model.nu == 2
    twin_release.require_stamp(DATA)
"""


def test_the_twin_release_fixture_provides_the_verified_release(released, data: Path) -> None:
    released.write("tests/test_policy.py", f"DATA = {str(data)!r}\n{USER_TEST}")
    released.run("tests").assert_outcomes(passed=1)
    bare = data.with_name("other.mcap")
    bare.write_bytes(data.read_bytes()[:-30])
    released.write("tests/test_policy.py", f"DATA = {str(bare)!r}\n{USER_TEST}")
    result = released.run("tests")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*other.mcap: not a whole MCAP file*"])


def test_the_twin_release_fixture_fails_if_the_release_is_damaged(released) -> None:
    released.write("tests/test_it.py", "def test_it(twin_release): pass\n")
    results = released.root / "releases" / "0001" / "results.json"
    results.write_text(results.read_text() + " ")
    result = released.run("tests")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*twin_release: *0001 does not hold: results.json: changed*"])
