"""``init ROBOT RECORDING...`` writes a replay golden per recording, with or without a tolerance."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import typed
import yaml
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pytest_twin.errors import SpecError
from pytest_twin.setup.recordings import TaskTolerance, parse_tolerance, place_recordings

pytestmark = pytest.mark.usefixtures("commands_in_process")

JOINT_STATE = "sensor_msgs/msg/JointState"
ROBOT = """\
<mujoco><worldbody><body name="link"><joint name="elbow" axis="0 1 0" range="-90 90" damping=".1"/>
<geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/></body></worldbody>
<actuator><position name="elbow" joint="elbow" kp="50" kv="2"/></actuator></mujoco>
"""


def run(*command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return typed.run(*command, cwd=cwd, state=cwd.parent)


def write_recording(path: Path) -> None:
    """Write a slow sweep that the robot follows with an error of some milliradians."""
    rows = ["time,elbow.position,elbow.command"]
    for k in range(200):
        wanted = 0.3 * math.sin(0.02 * k)
        rows.append(f"{0.02 * k:.3f},{wanted + 0.001 * math.cos(0.3 * k):.6f},{wanted:.6f}")
    path.write_text("\n".join(rows) + "\n")


def remove_other_goldens(twin: Path) -> None:
    """Keep the replays, so that each run of the gate takes a second."""
    for folder in (twin / "golden").iterdir():
        if folder.name != "replay":
            shutil.rmtree(folder)


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    (tmp_path / "twin").mkdir()
    (tmp_path / "logs").mkdir()
    (tmp_path / "twin" / "robot.xml").write_text(ROBOT)
    write_recording(tmp_path / "logs" / "sweep.csv")
    return tmp_path / "twin"


def test_without_a_given_tolerance_the_golden_has_a_placeholder_and_fails(twin: Path) -> None:
    made = run("pytest-twin", "init", "robot.xml", "../logs/sweep.csv", cwd=twin)
    assert made.returncode == 0, made.stdout + made.stderr
    remove_other_goldens(twin)
    path = twin / "golden" / "replay" / "sweep.yaml"
    golden = yaml.safe_load(path.read_text())
    assert golden["tolerance"] == {"angle_max": "<write what the task allows, such as 5 mrad>"}
    assert "expected" not in golden
    blank = "tolerance.angle_max: not written yet (expected what the task allows, in rad, such as"
    assert blank in made.stdout
    line = path.read_text().splitlines().index("  angle_max: " + golden["tolerance"]["angle_max"])
    for command in (("pytest",), ("pytest", "--twin-update"), ("pytest", "--twin-release")):
        found = run(*command, cwd=twin)
        assert found.returncode != 0
        assert f"sweep.yaml:{line + 1}: {blank} '5 mrad')" in found.stdout
        assert "signed" not in found.stdout
    path.write_text(path.read_text().replace(golden["tolerance"]["angle_max"], "60 mrad"))
    assert run("pytest", "--twin-update", cwd=twin).returncode == 0
    released = run("pytest", "--twin-release", cwd=twin)
    assert released.returncode == 0, released.stdout[-2000:]
    assert "release 0001 signed" in released.stdout


def test_the_given_tolerance_is_written_even_if_the_replay_exceeds_it(twin: Path) -> None:
    made = run(
        "pytest-twin", "init", "robot.xml", "../logs/sweep.csv", "--tolerance", "0.01mrad",
        cwd=twin,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    golden = yaml.safe_load((twin / "golden" / "replay" / "sweep.yaml").read_text())
    assert golden["tolerance"] == {"angle_max": "0.01mrad"}
    report = json.loads((twin / ".twin" / "init.json").read_text())
    assert report["unwritten"] == []
    assert report["failing"]["golden/replay/sweep"].startswith("angle_max of elbow exceeded ")
    assert "FAILS now: golden/replay/sweep" in made.stdout
    assert run("pytest", "golden/replay", cwd=twin).returncode == 1


def test_a_tolerance_can_be_given_for_one_joint(twin: Path) -> None:
    made = run(
        "pytest-twin", "init", "robot.xml", "../logs/sweep.csv", "--tolerance", "elbow=3deg",
        cwd=twin,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    golden = yaml.safe_load((twin / "golden" / "replay" / "sweep.yaml").read_text())
    assert golden["target"]["joints"] == {"elbow": {"angle_max": "3deg"}}
    assert yaml.safe_load((twin / "twin.yaml").read_text())["roots"]["recordings"] == str(
        twin.parent / "logs"
    )
    assert run("pytest", "golden/replay", cwd=twin).returncode == 0


@pytest.mark.parametrize(
    ("tolerance", "words"),
    [
        ("wrist=3deg", "--tolerance: no hinge or slide joint of this name (got 'wrist'; expected"),
        ("elbow=3mm", "joint 'elbow' is a hinge (got '3mm'; expected a unit that fits"),
        ("5", "the unit is missing"),
        ("5s", "unit 's' does not fit"),
        ("0mrad", "not a tolerance"),
    ],
)
def test_an_invalid_tolerance_is_refused(twin: Path, tolerance: str, words: str) -> None:
    made = run(
        "pytest-twin", "init", "robot.xml", "../logs/sweep.csv", "--tolerance", tolerance, cwd=twin
    )
    assert made.returncode == 2
    assert words in made.stderr
    assert not (twin / "twin.yaml").exists()


def test_an_unusable_recording_is_left_out_and_the_reason_is_reported(twin: Path) -> None:
    (twin.parent / "logs" / "empty.csv").write_text("time,elbow.position,elbow.command\n")
    made = run(
        "pytest-twin", "init", "robot.xml", "../logs/sweep.csv", "../logs/empty.csv",
        "--tolerance", "60mrad", cwd=twin,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    report = json.loads((twin / ".twin" / "init.json").read_text())
    assert list(report["left_out"]) == ["empty.csv"]
    assert "golden/replay/sweep" in report["goldens"]


def test_tolerances_are_parsed_with_their_units() -> None:
    assert parse_tolerance("5mrad,0.2 mm,wrist=2 mrad") == TaskTolerance(
        {"angle_max": "5mrad", "position_max": "0.2 mm"}, {"wrist": {"angle_max": "2 mrad"}}
    )
    with pytest.raises(SpecError, match="two tolerances for the same joints"):
        parse_tolerance("5mrad,1deg")
    with pytest.raises(SpecError, match="two tolerances for the same joints"):
        parse_tolerance("a=5mrad,a=1mm")


def test_recordings_are_not_moved(tmp_path: Path) -> None:
    twin = tmp_path / "twin"
    for path in ("twin/recordings/a.mcap", "logs/b.mcap", "logs/day2/c.mcap"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).touch()
    given = [twin / "recordings/a.mcap", tmp_path / "logs/b.mcap", tmp_path / "logs/day2/c.mcap"]
    assert place_recordings(given, twin) == (
        ["recordings/a.mcap", "b.mcap", "day2/c.mcap"],
        tmp_path / "logs",
    )
    with pytest.raises(SpecError, match="no such recording"):
        place_recordings([tmp_path / "gone.mcap"], twin)
    with pytest.raises(SpecError, match="given twice"):
        place_recordings([given[0], given[0]], twin)


def write_bag(folder: Path) -> None:
    """The sweep as a rosbag2 folder with SQLite storage."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    header, state = (store.types[name] for name in ("std_msgs/msg/Header", JOINT_STATE))
    time = store.types["builtin_interfaces/msg/Time"]
    empty = np.array([])
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = [
            writer.add_connection(topic, JOINT_STATE, typestore=store)
            for topic in ("/joint_states", "/joint_commands")
        ]
        for k in range(200):
            stamp = 1_000_000_000 + 20_000_000 * k
            wanted = np.array([0.3 * math.sin(0.02 * k)])
            error = np.array([0.001 * math.cos(0.3 * k)])
            for topic, position in zip(topics, (wanted + error, wanted), strict=True):
                message = state(
                    header(time(*divmod(stamp, 1_000_000_000)), ""), ["elbow"], position, empty,
                    empty,
                )  # fmt: skip
                writer.write(topic, stamp, store.serialize_cdr(message, JOINT_STATE))


def test_a_rosbag2_folder_can_be_the_recording_of_a_golden(twin: Path) -> None:
    write_bag(twin / "recordings" / "sweep")
    made = run(
        "pytest-twin", "init", "robot.xml", "recordings/sweep", "--tolerance", "60mrad", cwd=twin
    )
    assert made.returncode == 0, made.stdout + made.stderr
    golden = yaml.safe_load((twin / "golden" / "replay" / "sweep.yaml").read_text())
    assert golden["target"]["recording"] == "recordings/sweep"
    remove_other_goldens(twin)
    released = run("pytest", "--twin-release", cwd=twin)
    assert released.returncode == 0, released.stdout[-2000:]
    assert list((twin / "releases" / "0001" / "files" / "recordings" / "sweep").iterdir())
    with (twin / "recordings" / "sweep" / "metadata.yaml").open("a") as stream:
        stream.write("\n")
    why = run("pytest", "--twin-why", cwd=twin)
    assert "recording:recordings/sweep" in why.stdout
