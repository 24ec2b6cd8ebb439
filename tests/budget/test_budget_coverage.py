"""Predicted position error of the tool against the true one, in simulated calibrated cells."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "calibration")]

import cells
from budget_files import declared, make_twin

from pytest_twin.budget.budget_of_twin import budget_of_file
from pytest_twin.calibration.calibrate import calibrate
from pytest_twin.metrics.pose import inverse, rigid
from pytest_twin.realization.serial_chain import SerialChain

_CELLS = 4
_POSES = 12


def as_mjcf(chain: SerialChain) -> str:
    """MJCF of the chain, with a site at its end."""

    def pose_text(pose: np.ndarray) -> str:
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        numbers = (" ".join(f"{v:.17g}" for v in part) for part in (pose[:3, 3], quaternion))
        return 'pos="{}" quat="{}"'.format(*numbers)

    text = ""
    for joint, placement in zip(chain.joints, chain.placements, strict=True):
        text += f'<body {pose_text(placement)}><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        text += f'<joint name="{joint}" axis="0 0 1"/>'
    text += f'<site name="flange" {pose_text(chain.end)}/>' + "</body>" * len(chain.joints)
    return f"<mujoco><worldbody>{text}</worldbody></mujoco>"


def estimated(record: dict, name: str) -> np.ndarray:
    transform = record["records"][name]["transform"]
    turn = Rotation.from_quat(transform["quaternion_wxyz"], scalar_first=True)
    return rigid(turn.as_matrix(), np.array(transform["xyz"]))


def test_the_position_error_of_the_tool_agrees_with_the_budget(tmp_path: Path) -> None:
    """The world position of an object that the flange camera sees: error divided by prediction."""
    ratios = []
    for seed in range(_CELLS):
        rng = np.random.default_rng(seed)
        chain = cells.arm(6, rng)
        zeros = rng.normal(0.0, 0.02, 6)
        zeros[[0, -1]] = 0.0
        cell = cells.joint_cell(rng, chain, 25, zeros=zeros, translation=1e-3, rotation=2e-3)
        record = calibrate(
            cells.plan("joint_zeros", "hand_eye", "base_world"), cell.observations, chain
        )
        assert record["verdict"] == "accepted"
        readings = rng.uniform(-1.0, 1.0, (_POSES, 6))
        found = np.zeros(6)
        for joint, one in record["records"]["joint_zeros"]["values"].items():
            found[chain.joints.index(joint)] = one["value"]
        seen = inverse(cell.mounted)
        true = inverse(cell.world) @ cells.forward(chain, readings + zeros)
        estimate = (
            estimated(record, "base_world")
            @ cells.forward(chain, readings + found)
            @ estimated(record, "hand_eye")
            @ seen
        )
        errors = np.linalg.norm((estimate - true)[:, :3, 3], axis=1)
        poses = [dict(zip(chain.joints, row, strict=True)) for row in readings.tolist()]
        budget = declared(poses).replace("frame: tool", "frame: flange")
        twin = make_twin(tmp_path / str(seed), [record], budget=budget, arm=as_mjcf(chain))
        total = budget_of_file(str(twin))["total"]["sampled"]
        ratios.append(np.mean(errors**2) / total["position"] ** 2)
    # Each ratio is chi-square distributed, divided by its degrees of freedom; the mean is 1.
    assert 0.5 < np.mean(ratios) < 1.7, ratios
    assert max(ratios) < 5.0, ratios
