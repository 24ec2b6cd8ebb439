"""Inverse dynamics of joints on a floating base whose motion was recorded."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin import cli
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import load

sys.path.insert(0, str(Path(__file__).parents[1] / "replay"))
from moving_trunk import COLUMNS, FREE, Motion, moved_trunk

pytestmark = pytest.mark.usefixtures("commands_in_process")
JOINTS = ("hip", "knee")


def test_efforts_on_a_moving_base_are_those_of_mujoco(tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    robot = load(tmp_path / "free.xml")
    regressor = Regressor(robot, JOINTS, has_moving_base=True)
    random = np.random.default_rng(0)
    position, velocity, acceleration = random.uniform(-2.0, 2.0, (3, 20, 2))
    pose = random.standard_normal((20, 7))
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    speed, change = random.uniform(-3.0, 3.0, (2, 20, 6))
    found = regressor.matrix(position, velocity, acceleration, (pose, speed, change))
    model, data = robot.model, mujoco.MjData(robot.model)
    for row in range(20):
        data.qpos[:] = np.concatenate([pose[row], position[row]])
        data.qvel[:] = np.concatenate([speed[row], velocity[row]])
        data.qacc[:] = np.concatenate([change[row], acceleration[row]])
        mujoco.mj_inverse(model, data)
        effort = found[row] @ regressor.prior
        assert effort == pytest.approx(data.qfrc_inverse[-2:], abs=1e-9)


@pytest.mark.nightly
def test_friction_on_a_moving_base_is_identified_from_efforts(tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    motion = Motion(seconds=5.0, added_damping=0.15, noise=5e-5)
    names = [moved_trunk(seed, motion).write(tmp_path / f"{seed}.csv", efforts=True)
             for seed in range(3)]  # fmt: skip
    words = [str(tmp_path / "free.xml"), *map(str, names[:2]), "--held-out", str(names[2])]
    cli.main(["identify", *words, "--out", str(tmp_path / "out")])
    document = json.loads((tmp_path / "out" / "identification.json").read_text())
    friction = document["parameters"]["knee.viscous_friction"]
    assert friction["ci95"][0] <= 0.2 <= friction["ci95"][1]
    assert document["held_out"]["knee"]["effort_relative"] < 0.05
    at_rest = [str(name) for name in names]
    for name in names:
        lines = name.read_text().splitlines()
        columns = [i for i, h in enumerate(lines[0].split(",")) if h not in COLUMNS]
        kept = [",".join(np.array(line.split(","))[columns]) for line in lines]
        name.write_text("\n".join(kept))
    fixed = ["identify", *words[:1], *at_rest, "--base", "fixed", "--out", str(tmp_path / "f")]
    cli.main(fixed)
    wrong = json.loads((tmp_path / "f" / "identification.json").read_text())
    assert wrong["held_out"]["knee"]["effort_relative"] > 0.2


def test_damping_on_a_moving_base_is_identified_from_commands_and_positions(tmp_path: Path) -> None:
    (tmp_path / "free.xml").write_text(FREE)
    motion = Motion(seconds=4.0, added_damping=0.15, noise=2e-4)
    names = [str(moved_trunk(seed, motion).write(tmp_path / f"{seed}.csv")) for seed in range(3)]
    words = [str(tmp_path / "free.xml"), *names[:2], "--held-out", names[2]]
    options = ["--command-between", "interpolated", "--out", str(tmp_path / "out")]
    assert cli.main(["identify", *words, *options]) == 0
    document = json.loads((tmp_path / "out" / "identification.json").read_text())
    assert document["way"] == "commands and positions"
    values = {name: one["value"] for name, one in document["parameters"].items()}
    # The servo's own damping is 0.2 N*m*s/rad; only the sum with the joint's moves the knee.
    damping = values.get("knee.viscous_friction", 0.0)
    damping += 0.2 * values.get("knee.controller_gain.damping_error", 0.0)
    assert damping == pytest.approx(0.15, rel=0.1)
    for error in document["held_out"].values():
        assert error["position_rms"] < 3.0 * error["noise_floor"]
