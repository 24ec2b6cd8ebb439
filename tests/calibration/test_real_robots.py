"""Recorded data of a Franka FR3 with a camera and of a TIAGo with markers on its hand."""

from __future__ import annotations

import csv
import os
import shutil
from pathlib import Path
from typing import Any

import fr3
import numpy as np
import pytest
from nightly import samples

from pytest_twin.calibration.calibrate import calibrate_file

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or Path(__file__).parents[3] / "shared" / "recordings"
)


def recordings_folder(name: str) -> Path:
    folder = RECORDINGS / name
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: the variable TWIN_RECORDINGS names the place")
    return folder


def calibrated(folder: Path, plan: str) -> dict[str, Any]:
    (folder / "calibration.yaml").write_text(plan)
    return calibrate_file(str(folder / "calibration.yaml"))


@pytest.mark.parametrize("seeds", samples(4, always=(0, 1)))
@pytest.mark.parametrize(
    ("estimate", "translation"),
    [
        ("hand_eye, base_world", 0.00511),
        ("hand_eye, base_world, joint_zeros", 0.00186),
        ("hand_eye, base_world, joint_zeros, geometry", 0.00142),
    ],
)
def test_held_out_errors_of_the_fr3_are_below_their_bounds(
    tmp_path: Path, estimate: str, translation: float, seeds: tuple[int, ...]
) -> None:
    shutil.copy(recordings_folder("fr3") / "observations.csv", tmp_path)
    (tmp_path / "fr3.urdf").write_text(fr3.urdf())
    errors = []
    for seed in seeds:
        found = calibrated(
            tmp_path,
            "calibration: fr3\nrobot: fr3.urdf\nflange: fr3_link8\n"
            f"observations: observations.csv\nestimate: [{estimate}]\ncamera: {{mount: hand}}\n"
            f"hold_out: {{fraction: 0.33, seed: {seed}}}\n",
        )
        errors.append(found["held_out"]["translation_rms"])
        assert found["suspected"] == []
        if "joint_zeros" in estimate:
            low, high = found["records"]["joint_zeros"]["values"]["fr3_joint5"]["ci95"]
            assert 0.018 < low < high < 0.030
    assert np.sqrt(np.mean(np.square(errors))) < translation


def write_tiago(folder: Path) -> None:
    source = recordings_folder("tiago")
    shutil.copy(source / "tiago.urdf", folder)
    with (source / "mocap.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    names = {
        name: f"joint.{name}" if name.endswith("joint") else f"point.m{name[1]}.{name[0]}"
        for name in rows[0]
    }
    with (folder / "observations.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["id", *names.values()])
        writer.writerows([number, *row.values()] for number, row in enumerate(rows))


def test_joint_zeros_from_markers_reduce_the_errors_of_the_tiago(tmp_path: Path) -> None:
    write_tiago(tmp_path)
    plan = (
        "calibration: tiago\nrobot: tiago.urdf\nflange: arm_tool_link\n"
        "observations: observations.csv\nestimate: [{}]\nhold_out: {{fraction: 0.0}}\n"
    )
    without = calibrated(tmp_path, plan.format("base_world"))
    found = calibrated(tmp_path, plan.format("base_world, joint_zeros"))
    assert found["excluded"][0]["id"] == "point.m4"
    assert "markers m3 and m4 are at the same place in all 34 rows" in found["excluded"][0]["why"]
    before, after = (one["fitted"]["leave_one_out"]["translation_rms"] for one in (without, found))
    assert after < before
    held = {"torso_lift_joint", "arm_1_joint", "arm_7_joint"}
    assert not held & set(found["records"]["joint_zeros"]["values"])
    assert all(any(joint in words for words in found["unobservable"]) for joint in held)
