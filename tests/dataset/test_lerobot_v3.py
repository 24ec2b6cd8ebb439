"""A data set of version 3.0 with a video, as LeRobot 0.6.1 wrote it (`lerobot_v3/`).

Three episodes of 2 s lie in one file. The view of the third is shifted by 6 of 96 pixels.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pytest_twin.cli import main
from pytest_twin.formats.recordings.lerobot_video import episode_videos, grey_frames

pytest.importorskip("av")
pytestmark = pytest.mark.usefixtures("commands_in_process")
DATASET = Path(__file__).parent / "lerobot_v3"
CAMERA = "observation.images.front"


def test_images_are_those_of_their_episode_within_a_common_file() -> None:
    info = json.loads((DATASET / "meta/info.json").read_text())
    videos = episode_videos(DATASET, info, CAMERA, dict.fromkeys(range(3), 2.0))
    assert [(video.begin, video.end) for video in videos] == [(0, 2), (2, 4), (4, 6)]
    first, second, third = (grey_frames(video, 3, 96) for video in videos)
    np.testing.assert_allclose(first, second, atol=2.0)
    np.testing.assert_allclose(np.roll(first, 6, axis=2)[:, :, 8:], third[:, :, 8:], atol=12.0)
    assert np.abs(first - third).max() > 50.0


def test_the_lag_and_the_moved_camera_are_found(tmp_path: Path) -> None:
    assert main(["check-dataset", str(DATASET), "--out", str(tmp_path)]) == 1
    report = json.loads((tmp_path / "check-dataset.json").read_text())
    found = {one["code"]: one["episodes"] for one in report["findings"]}
    # All episodes of this recorded set have the same motion, under other images.
    assert found == {"camera_moved": [2], "copied_episode": [1, 2]}
    lags = [joint["lag"]["value"] for joint in report["joints"].values()]
    np.testing.assert_allclose(lags, 2 / 30, atol=0.002)
