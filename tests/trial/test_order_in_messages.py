"""The order of joints inside a message changes nothing."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.realization import load
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recording_at

JOINTS = ("shoulder", "elbow", "wrist")
TOPICS = {"state": "/joint_states", "command": "/joint_commands"}
ARM = (
    "<mujoco><worldbody>"
    + "".join(
        f'<body pos=".3 0 0"><joint name="{name}" axis="0 1 0"/><geom size=".05" mass="1"/>'
        for name in JOINTS
    )
    + "</body>" * 3
    + "</worldbody><actuator>"
    + "".join(f'<position joint="{name}" kp="50"/>' for name in JOINTS)
    + "</actuator></mujoco>"
)


def write(path: Path, states: tuple[str, ...], commands: tuple[str, ...]) -> Path:
    """Recording with these orders of joints in its messages."""
    stamp = 10**18 + 10**7 * np.arange(200)
    wave = {name: np.sin(np.arange(200) / (20 + 5 * place)) for place, name in enumerate(JOINTS)}

    def table(names: tuple[str, ...], scale: float) -> np.ndarray:
        return np.column_stack([scale * wave[name] for name in names])

    state = JointSeries(
        "/joint_states", states, stamp, stamp, table(states, 0.3), table(states, 0.2),
        table(states, 4.0),
    )  # fmt: skip
    command = JointSeries(
        "/joint_commands", commands, stamp, stamp, table(commands, 0.31), None, None
    )
    write_recording(path, [state, command], {"command_between": "held"})
    return path


@pytest.mark.parametrize("order", list(permutations(JOINTS)))
def test_trials_have_the_joints_in_the_order_of_the_model(
    order: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    structure = load(tmp_path / "arm.xml").structure
    first, other = (
        make_trials(recording_at(path, TOPICS), structure)[0]
        for path in (
            write(tmp_path / "a.mcap", JOINTS, JOINTS),
            write(tmp_path / "b.mcap", order, order[::-1]),
        )
    )
    assert first.joints == other.joints == JOINTS
    for name in ("position", "velocity", "effort", "command"):
        assert np.array_equal(getattr(first, name), getattr(other, name))


def test_the_model_of_the_test_has_the_joints_in_this_order() -> None:
    model = mujoco.MjModel.from_xml_string(ARM)
    assert tuple(model.joint(i).name for i in range(model.njnt)) == JOINTS
