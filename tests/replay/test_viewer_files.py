"""``--view`` and ``--rerun``: both robots, their joints and a layout, in one file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from pytest_twin import cli

pytestmark = pytest.mark.usefixtures("commands_in_process")

ROBOT = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="arm" pos="0 0 .5">
      <joint name="elbow" axis="0 1 0" damping="1"/>
      <geom type="box" size=".2 .02 .02" pos=".2 0 0"/>
      <body name="tip" pos=".4 0 0"><geom type="mesh" mesh="wedge"/></body>
    </body>
  </worldbody>
  <actuator><position name="elbow" joint="elbow" kp="50"/></actuator>
</mujoco>
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "arm.xml").write_text(ROBOT)
    time = np.arange(0.0, 1.0, 0.01)
    rows = [f"{t:.2f},{0.3 * np.sin(4 * t):.6f},{0.3 * np.sin(4 * t + 0.1):.6f}" for t in time]
    head = "time,elbow.position,elbow.command\n"
    (tmp_path / "log.csv").write_text(head + "\n".join(rows) + "\n")
    return tmp_path


def replay(folder: Path, *options: str) -> int:
    names = [str(folder / name) for name in ("arm.xml", "log.csv", "out.mcap")]
    return cli.main(["replay", names[0], names[1], "--out", names[2], *options])


def test_the_file_has_both_robots_their_frames_and_the_plots_of_its_layout(folder: Path) -> None:
    assert replay(folder, "--view", str(folder / "view.mcap")) == 0
    messages: dict[str, list[dict]] = {}
    with (folder / "view.mcap").open("rb") as stream:
        reader = make_reader(stream)
        for schema, channel, message in reader.iter_messages():
            assert schema.encoding == "jsonschema"
            messages.setdefault(channel.topic, []).append(json.loads(message.data))
        attached = {one.name: one.data for one in reader.iter_attachments()}
    assert attached["arm.xml"].decode() == ROBOT
    layout = json.loads(attached["layout.json"])
    assert layout == json.loads((folder / "view.layout.json").read_text())
    frames = messages["/tf"]
    assert 40 <= len(frames) <= 51
    names = {one["child_frame_id"] for one in frames[0]["transforms"]}
    assert names == {f"{robot}/{body}" for robot in ("measured", "predicted")
                     for body in ("arm", "tip")}  # fmt: skip
    for robot in ("measured", "predicted"):
        (scene,) = messages[f"/{robot}/robot"]
        assert {one["frame_id"] for one in scene["entities"]} <= names
        for entity in scene["entities"]:
            (triangles,) = entity["triangles"]
            assert max(triangles["indices"]) < len(triangles["points"])
    joints = messages["/joints/elbow"]
    assert len(joints) == 100
    at = joints[50]
    assert at["residual"] == pytest.approx(at["predicted"] - at["measured"])
    # The measured tip is where the measured angle puts it.
    pose = {one["child_frame_id"]: one["translation"] for one in frames[0]["transforms"]}
    tip = 0.4 * np.array([np.cos(joints[0]["measured"]), -np.sin(joints[0]["measured"])])
    found = [pose["measured/tip"]["x"], pose["measured/tip"]["z"] - 0.5]
    assert found == pytest.approx(tip.tolist(), abs=1e-6)
    for panel, settings in layout["configById"].items():
        for path in settings.get("paths", ()):
            topic, _, field = path["value"].partition(".")
            assert field in messages[topic][0], panel
        assert set(settings.get("topics", ())) <= set(messages)
    assert set(layout["configById"]) == set(panels(layout["layout"]))


def panels(node: object) -> list[str]:
    if isinstance(node, str):
        return [node]
    assert isinstance(node, dict)
    assert node["direction"] in ("row", "column")
    return [*panels(node["first"]), *panels(node["second"])]


def test_a_file_of_rerun_is_written(folder: Path) -> None:
    pytest.importorskip("rerun", reason="extra rerun")
    assert replay(folder, "--rerun", str(folder / "view.rrd")) == 0
    assert (folder / "view.rrd").read_bytes()[:4] == b"RRF2"


def test_two_results_in_one_file_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(folder, "--view", str(folder / "out.mcap")) == 2
    assert "one file for two results" in capsys.readouterr().err


def test_a_diagnosis_shows_what_its_patched_model_predicts(folder: Path) -> None:
    command = ["diagnose", str(folder / "arm.xml"), str(folder / "log.csv"), "--seconds", "3"]
    view = folder / "diagnosed.mcap"
    assert cli.main([*command, "--out", str(folder / "d"), "--view", str(view)]) in (0, 1)
    with view.open("rb") as stream:
        reader = make_reader(stream)
        topics = {channel.topic for _, channel, _ in reader.iter_messages()}
        attached = {one.name: one.data for one in reader.iter_attachments()}
    assert {"/measured/robot", "/predicted/robot", "/tf", "/joints/elbow"} <= topics
    # The model in the file is the patched one.
    assert attached["model.xml"] == (folder / "d/realization/model.xml").read_bytes()


def test_a_fleet_takes_no_file_for_viewers(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["diagnose", "--fleet", str(folder / "f.yaml"), "--out", str(folder / "d")]
    assert cli.main([*command, "--view", str(folder / "view.mcap")]) == 2
    assert "only for the diagnosis of one robot" in capsys.readouterr().err
