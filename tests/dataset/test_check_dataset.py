"""``pytest-twin check-dataset``: faults in LeRobot data sets are found, sound ones are silent."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import jsonschema
import numpy as np
import pytest
from demonstrations import COUNT, FPS, Episode, calibration, demonstrations, write

from pytest_twin import cli
from pytest_twin.dataset.frames import hidden_losses
from pytest_twin.formats.schema import load_schema

pytestmark = pytest.mark.usefixtures("commands_in_process")


def check(folder: Path, *options: str) -> tuple[int, dict[str, Any]]:
    out = folder.parent / "out"
    status = cli.main(["check-dataset", str(folder), "--out", str(out), *options])
    document = json.loads((out / "check-dataset.json").read_text())
    jsonschema.validate(document, load_schema("results/check-dataset.schema.json"))
    assert (status == 0) == (document["findings"] == [])
    return status, document


def found(document: dict[str, Any]) -> set[tuple[str, str | None]]:
    return {(one["code"], one["joint"]) for one in document["findings"]}


def unknown(document: dict[str, Any]) -> str:
    return "\n".join(f"{one['what']}: {one['why']}" for one in document["unknown"])


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_sound_demonstrations_are_silent(
    tmp_path: Path, version: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, document = check(write(tmp_path / "set", demonstrations(), version))
    assert (status, document["findings"]) == (0, [])
    pan = document["joints"]["shoulder_pan"]
    assert pan["lag"]["value"] == pytest.approx(0.09, abs=0.01)
    assert pan["gain"] == pytest.approx(1.0, abs=0.02)
    assert "LeRobot computes them and records no time" in unknown(document)
    assert "leader and follower may be off together" in unknown(document)
    assert "nothing found" in capsys.readouterr().out
    page = (tmp_path / "out" / "check-dataset.html").read_text()
    assert "Nothing found" in page or "nothing found" in page
    assert "shoulder_lift" in page


def offset(joint: int, degrees: float, since: int = 0) -> Callable[[int, Episode], None]:
    def change(number: int, episode: Episode) -> None:
        if number >= since:
            episode["state"][:, joint] += degrees

    return change


def test_an_offset_of_17_degrees_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=offset(2, 17.0))))
    assert found(document) == {("offset", "elbow_flex")}
    assert document["joints"]["elbow_flex"]["offset"] == pytest.approx(18.5, abs=1.0)
    assert "elbow_flex: the follower is +18" in capsys.readouterr().out


def test_a_small_offset_may_be_sag(tmp_path: Path) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=offset(1, -4.0))))
    assert document["findings"] == []
    assert "offset of shoulder_lift (-5." in unknown(document)


def test_an_offset_since_an_episode_is_drift(tmp_path: Path) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=offset(3, 6.0, since=7))))
    assert found(document) == {("drift", "wrist_flex")}
    (one,) = document["findings"]
    assert one["episodes"] == list(range(7, 12))


def late(number: int, episode: Episode) -> None:
    frame = np.arange(len(episode["time"]))
    for joint in (0, 1):
        moved = np.interp(frame - 9, frame, episode["state"][:, joint])
        episode["state"][:, joint] = moved


def swap(number: int, episode: Episode) -> None:
    episode["state"][:, [0, 4]] = episode["state"][:, [4, 0]]


def reverse(number: int, episode: Episode) -> None:
    episode["state"][:, 4] *= -1.0


def shrink(number: int, episode: Episode) -> None:
    episode["state"][:, 4] *= 0.7


def stick(number: int, episode: Episode) -> None:
    if number == 5:
        episode["state"][60:180, 0] = episode["state"][60, 0]


def shift_early(number: int, episode: Episode) -> None:
    episode["state"][:-5] = episode["state"][5:].copy()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (late, {("lag", "shoulder_pan"), ("lag", "shoulder_lift")}),
        (swap, {("swapped", "shoulder_pan"), ("swapped", "wrist_roll")}),
        (reverse, {("direction", "wrist_roll")}),
        (shrink, {("gain", "wrist_roll")}),
        (stick, {("stuck", "shoulder_pan")}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_fault_of_a_joint_is_found(
    tmp_path: Path, change: Callable[[int, Episode], None], expected: set[tuple[str, str]]
) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=change)))
    assert found(document) == expected


def in_episode_5(edit: Callable[[Episode], None]) -> Callable[[int, Episode], None]:
    """Edit a single episode, among eleven sound ones."""

    def change(number: int, episode: Episode) -> None:
        if number == 5:
            edit(episode)

    return change


def reverse_elbow(episode: Episode) -> None:
    episode["state"][:, 2] *= -1.0


def move_elbow_zero(episode: Episode) -> None:
    episode["state"][:, 2] += 17.0


def slip_in_the_middle(episode: Episode) -> None:
    episode["state"][100:, 2] += 17.0


def lag_by_20_frames(episode: Episode) -> None:
    episode["state"][20:, 2] = episode["state"][:-20, 2].copy()


def widen(episode: Episode) -> None:
    episode["state"][:, 2] *= 1.5


def read_zeros(episode: Episode) -> None:
    episode["state"][60:70, 2] = 0.0


def freeze_the_leader(episode: Episode) -> None:
    episode["action"][:, 2] = episode["action"][0, 2]


@pytest.mark.parametrize(
    "edit",
    [
        reverse_elbow,
        move_elbow_zero,
        slip_in_the_middle,
        lag_by_20_frames,
        widen,
        read_zeros,
        freeze_the_leader,
    ],
)
def test_one_episode_unlike_the_others_is_found(
    tmp_path: Path, edit: Callable[[Episode], None]
) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=in_episode_5(edit))))
    (one,) = [one for one in document["findings"] if one["code"] == "unlike_others"]
    assert (one["joint"], one["episodes"]) == ("elbow_flex", [5])
    assert {joint for _, joint in found(document)} == {"elbow_flex"}


def drift_slowly(number: int, episode: Episode) -> None:
    episode["state"][:, 2] += 0.5 * number


def add_noise(number: int, episode: Episode) -> None:
    episode["state"][:, 2] += np.random.default_rng(number).normal(0.0, 2.0, len(episode["time"]))


def round_to_5_degrees(number: int, episode: Episode) -> None:
    episode["state"][:, 2] = np.round(episode["state"][:, 2] / 5.0) * 5.0


def lose_a_number(number: int, episode: Episode) -> None:
    if number == 5:
        episode["state"][50, 2] = np.nan


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (drift_slowly, "drift"),
        (add_noise, "noise"),
        (round_to_5_degrees, "resolution"),
        (lose_a_number, "not_finite"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_fault_of_one_encoder_is_found(
    tmp_path: Path, change: Callable[[int, Episode], None], code: str
) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=change)))
    assert found(document) == {(code, "elbow_flex")}


def test_a_copied_episode_is_found(tmp_path: Path) -> None:
    episodes = demonstrations()
    episodes[6] = episodes[2]
    _, document = check(write(tmp_path / "set", episodes))
    (one,) = document["findings"]
    assert (one["code"], one["episodes"]) == ("copied_episode", [6])
    assert "episode 2" in one["text"]


def test_radians_that_are_declared_as_degrees_are_found(tmp_path: Path) -> None:
    def convert(number: int, episode: Episode) -> None:
        for name in ("state", "action"):
            episode[name] = np.radians(episode[name])

    folder = write(tmp_path / "set", demonstrations(change=convert))
    _, document = check(folder, "--units", "deg")
    assert ("units", None) in found(document)


def test_states_that_are_their_actions_are_found(tmp_path: Path) -> None:
    def copy(number: int, episode: Episode) -> None:
        episode["state"][:] = episode["action"]

    _, document = check(write(tmp_path / "set", demonstrations(change=copy)))
    assert {code for code, _ in found(document)} & {"copied", "unusable"}


def test_joints_swapped_in_both_arms_are_a_question(tmp_path: Path) -> None:
    def swap_both(number: int, episode: Episode) -> None:
        if number >= 8:
            for name in ("state", "action"):
                episode[name][:, [1, 2]] = episode[name][:, [2, 1]]

    _, document = check(write(tmp_path / "set", demonstrations(change=swap_both)))
    assert "start elsewhere from episode 8" in unknown(document)


def test_states_before_their_actions_are_found(tmp_path: Path) -> None:
    _, document = check(write(tmp_path / "set", demonstrations(change=shift_early)))
    assert {code for code, _ in found(document)} == {"lag"}


def test_actions_that_are_no_positions_are_not_compared(tmp_path: Path) -> None:
    def differences(number: int, episode: Episode) -> None:
        episode["action"] = np.diff(episode["action"], axis=0, append=episode["action"][-1:]) * 5

    _, document = check(write(tmp_path / "set", demonstrations(change=differences)))
    assert found(document) == set()
    assert "no joint follows its action" in unknown(document)


def test_episodes_in_radians_among_degrees_are_found_and_refused_elsewhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episodes = demonstrations()
    for name in ("action", "state"):
        episodes[4][name][:, :5] = np.radians(episodes[4][name][:, :5])
    folder = write(tmp_path / "set", episodes)
    _, document = check(folder)
    assert found(document) == {("units", None)}
    assert document["findings"][0]["episodes"] == [4]
    assert cli.main(["show", str(folder)]) == 2
    assert "episodes in different units" in capsys.readouterr().err


def test_encoder_counts_are_found(tmp_path: Path) -> None:
    episodes = demonstrations()
    for one in episodes:
        for name in ("action", "state"):
            one[name] = np.round(one[name] / COUNT) + 2048
    _, document = check(write(tmp_path / "set", episodes, units=None))
    assert found(document) == {("units", None)}
    assert document["unit"]["value"] == "counts"


def test_degrees_and_per_cent_are_not_told_apart(tmp_path: Path) -> None:
    episodes = demonstrations()
    for one in episodes:
        for name in ("action", "state"):
            one[name] = np.clip(one[name], -100.0, 100.0)
    _, document = check(write(tmp_path / "set", episodes, units=None))
    assert document["findings"] == []
    assert not document["unit"]["known"]
    assert "unit of the positions: " in unknown(document)


def test_states_outside_the_range_of_the_calibration_are_found(tmp_path: Path) -> None:
    folder = write(tmp_path / "set", demonstrations())
    narrow = calibration(tmp_path, half_range=1000)
    _, document = check(folder, "--robot", str(narrow))
    assert {code for code, _ in found(document)} == {"limits"}
    wide = calibration(tmp_path, half_range=2047)
    assert check(folder, "--motor-calibration", str(wide))[0] == 0


def test_lost_frames_with_their_stamps_are_found(tmp_path: Path) -> None:
    episodes = demonstrations()
    keep = np.delete(np.arange(240), [50, 90, 91, 130])
    episodes[3] = {name: values[keep] for name, values in episodes[3].items()}
    _, document = check(write(tmp_path / "set", episodes))
    (one,) = document["findings"]
    assert (one["code"], one["episodes"]) == ("dropped_frames", [3])
    assert one["text"] == "4 frames lost by the stamps, in 1 episode"


def test_lost_frames_under_regular_stamps_are_found(tmp_path: Path) -> None:
    def lose(number: int, episode: Episode) -> None:
        keep = np.delete(np.arange(240), np.arange(20, 220, 20))
        for name in ("action", "state"):
            episode[name] = episode[name][keep]
        episode["time"] = episode["time"][: len(keep)]

    _, document = check(write(tmp_path / "set", demonstrations(change=lose)))
    assert found(document) == {("dropped_frames", None)}
    assert "although the stamps are regular" in document["findings"][0]["text"]


def test_jerky_motion_without_lost_frames_is_not_taken_for_one_with_them() -> None:
    random = np.random.default_rng(1)
    time = np.arange(6000) / 50.0
    # Steps along one direction whose length changes from frame to frame, as under random commands.
    steps = np.abs(1.0 + 0.35 * random.standard_normal(len(time)))[:, None] * [0.03, 0.02, 0.01]
    assert hidden_losses([time], [np.cumsum(steps, axis=0)], [0]) == []
    lost = np.delete(np.cumsum(np.full((6000, 3), 0.02), axis=0), np.arange(100, 1000, 100), axis=0)
    (finding,) = hidden_losses([time[: len(lost)]], [lost], [0])
    assert finding.code == "dropped_frames"


def test_a_clock_at_another_rate_is_found(tmp_path: Path) -> None:
    episodes = demonstrations()
    for one in episodes:
        one["time"] = one["time"] * 1.01
    _, document = check(write(tmp_path / "set", episodes))
    assert found(document) == {("clock", None)}
    assert "29.7" in document["findings"][0]["text"]


def test_a_data_set_that_is_not_whole_is_found(tmp_path: Path) -> None:
    folder = write(tmp_path / "set", demonstrations(3), total_episodes=4)
    assert found(check(folder)[1]) == {("totals", None)}


def test_limits_are_those_of_the_robot_that_is_given(tmp_path: Path) -> None:
    joints = "".join(
        f'<body><joint name="{name}" axis="0 0 1" range="{low} {high}"/><geom size=".1"/></body>'
        for name, low, high in (("shoulder_pan", -90, 90), ("elbow_flex", -90, 100))
    )
    robot = tmp_path / "arm.xml"
    robot.write_text(f"<mujoco><worldbody>{joints}</worldbody></mujoco>")
    _, document = check(write(tmp_path / "set", demonstrations()), "--robot", str(robot))
    assert found(document) == {("beyond_range", "elbow_flex")}


def test_a_gripper_that_never_moves_is_found(tmp_path: Path) -> None:
    def stand(number: int, episode: Episode) -> None:
        episode["state"][:, 5] = 30.0

    _, document = check(write(tmp_path / "set", demonstrations(change=stand)))
    assert found(document) == {("stuck", "gripper")}


def film(folder: Path, episodes: int, moved_since: int | None, carried: bool = False) -> None:
    """Videos of a textured scene in which a block moves; the camera may move, or be carried."""
    random = np.random.default_rng(1)
    scene = np.kron(random.integers(0, 255, (40, 60)), np.ones((8, 8)))
    videos = folder / "videos" / "chunk-000" / "observation.images.top"
    videos.mkdir(parents=True)
    for number in range(episodes):
        shift = 6 if moved_since is not None and number >= moved_since else 0
        with av.open(str(videos / f"episode_{number:06d}.mp4"), "w") as container:
            stream = container.add_stream("libx264", rate=FPS)
            stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
            for at in range(45):
                place = shift + (at if carried else 0)
                image = scene[20:260, 40 + place : 360 + place].astype(np.uint8).copy()
                image[100 + at : 140 + at, 2 * at : 2 * at + 40] = 20
                frame = av.VideoFrame.from_ndarray(np.repeat(image[:, :, None], 3, 2), "rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())


@pytest.mark.parametrize(
    ("options", "verdict"),
    [({"moved_since": None}, "still"), ({"moved_since": 2}, "moved"),
     ({"moved_since": None, "carried": True}, "unknown")],
)  # fmt: skip
def test_a_camera_that_moved_between_episodes_is_found(
    tmp_path: Path, options: dict[str, Any], verdict: str
) -> None:
    path = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    folder = write(tmp_path / "set", demonstrations(4, 45), "v2.1", video_path=path)
    film(folder, 4, **options)
    _, document = check(folder)
    assert document["cameras"]["observation.images.top"]["verdict"] == verdict
    expected = {("camera_moved", "observation.images.top")} if verdict == "moved" else set()
    assert found(document) == expected
    if expected:
        assert document["findings"][0]["episodes"] == [2]
        assert "shifts by 1.9 % of the width" in document["findings"][0]["text"]


def test_a_folder_that_is_no_data_set_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["check-dataset", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert "not a LeRobot data set" in capsys.readouterr().err


def test_50_episodes_take_less_than_ten_seconds(tmp_path: Path) -> None:
    folder = write(tmp_path / "set", demonstrations(50, 450))
    begin = time.process_time()
    assert check(folder)[0] == 0
    assert time.process_time() - begin < 10.0
