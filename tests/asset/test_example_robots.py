"""Tests with a few real robots; ``benchmarks/assets.py`` covers all of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from asset_robots import FINGER, ROBOTS

from pytest_twin.asset.normalize import normalize
from pytest_twin.asset.realize import realize
from pytest_twin.realization import urdf


@pytest.mark.parametrize(
    "name",
    [
        "asr_twodof_description/urdf/TwoDofs.urdf",
        "double_pendulum_description/urdf/double_pendulum_continuous.urdf",
        "iris_description/robots/iris_simple.urdf",
        "human_description/robots/human.urdf",
        "alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf",
    ],
)
def test_mjcf_usd_and_pinocchio_forms_have_the_same_kinematics(tmp_path: Path, name: str) -> None:
    pytest.importorskip("urdf_usd_converter")
    made = realize(str(ROBOTS / name), str(tmp_path))
    assert made["critical"] == []
    matrix = json.loads((tmp_path / "loss.json").read_text())
    assert [held["target"] for held in matrix["conversions"]] == ["MJCF", "USD", "Pinocchio"]
    for held in matrix["conversions"]:
        rows = {row["feature"]: row for row in held["rows"]}
        for feature in ("forward kinematics, position", "forward kinematics, orientation"):
            assert rows[feature]["difference"] <= 1e-9, (held["target"], feature)
        assert rows["direction of every joint"]["verdict"] == "kept"


@pytest.mark.parametrize(
    ("name", "flagged"),
    [
        ("allegro_hand_description/urdf/allegro_left_hand.urdf", 4),
        ("pr2_description/urdf/pr2.urdf", 2),
        ("a1_description/urdf/a1.urdf", 0),
        ("finger_edu_description/robots/finger_edu.urdf", 0),
    ],
)
def test_impossible_inertias_are_flagged(tmp_path: Path, name: str, flagged: int) -> None:
    source = ROBOTS / name
    found = normalize(source, tmp_path)
    assert len([flag for flag in found.flags if flag.critical]) == flagged


def test_the_smallest_principal_moments_of_two_known_robots_are_reproduced() -> None:
    laas = urdf.read(ROBOTS / "romeo_description/urdf/romeo_laas_small.urdf")
    assert np.linalg.eigvalsh(laas.links["body"].inertia).min() == pytest.approx(-0.021, abs=5e-4)
    finger = urdf.read(FINGER).links["finger_lower_link"]
    assert np.linalg.eigvalsh(finger.inertia).min() == pytest.approx(0.0, abs=1e-12)
    assert finger.mass > 0
