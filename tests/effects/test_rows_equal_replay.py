"""The batch simulator without effects and the replay predict the same motion."""

from __future__ import annotations

import copy
import os
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.diagnosis.patched.delays import effects_outside_mjcf, without_delays
from pytest_twin.diagnosis.patched.replay import fixed_values
from pytest_twin.diagnosis.windows import segments_of
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.segment import Segment
from pytest_twin.formats.mcap import JointSeries, Recording, read_recording
from pytest_twin.open_loop import Row, replay, replay_rows
from pytest_twin.realization import load
from pytest_twin.trial import CommandMode, Trial, make_trial

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or Path(__file__).parents[3] / "shared" / "recordings"
).resolve()
ARM = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body name="upper"><joint name="shoulder" axis="0 1 0" damping=".4" frictionloss=".3"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
<body name="fore" pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping=".2" frictionloss=".1"
armature=".01"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5"/></body></body>
</worldbody><actuator>{}</actuator></mujoco>
"""
DRIVES = {
    "position": '<position joint="shoulder" kp="60" kv="2" forcerange="-9 9"/>'
    '<position joint="elbow" kp="30" kv="1" gear="2"/>',
    "velocity": '<velocity joint="shoulder" kv="5"/><velocity joint="elbow" kv="3"/>',
    "effort": '<motor joint="shoulder" gear="3"/><motor joint="elbow"/>',
}
SCALE = {"position": 0.4, "velocity": 0.8, "effort": 2.0}


def dry_friction_as_rows(model: mujoco.MjModel, joints: tuple[str, ...]) -> mujoco.MjModel:
    """A copy with the stiff dry friction of the batch rows; MuJoCo's default creeps under load."""
    stiff_friction = copy.copy(model)
    dofs = [int(model.joint(joint).dofadr[0]) for joint in joints]
    stiff_friction.dof_solref[dofs] = (2.0 * model.opt.timestep, 1.0)
    stiff_friction.dof_solimp[dofs, :3] = (0.999, 0.9999, 0.001)
    return stiff_friction


def compare_rows_with_replay(model: mujoco.MjModel, trial: Trial) -> tuple[float, float, float]:
    """Largest differences in position (rad) and velocity (rad/s), and the range of motion (rad)."""
    replayed = replay_rows([Row(trial, dry_friction_as_rows(model, trial.joints))], threads=1)[0]
    assert replayed.error is None
    column = {joint: i for i, joint in enumerate(trial.command_joints)}
    command = np.full((len(trial.command_time), len(trial.joints)), np.nan)
    for j, joint in enumerate(trial.joints):
        if joint in column:
            command[:, j] = trial.command[:, column[joint]]
    still = np.zeros(len(trial.joints))
    velocity = still if trial.velocity is None else np.nan_to_num(trial.velocity[0])
    segment = Segment(
        trial=0, model=model, mode=trial.command_mode, start=0.0, time=trial.time,
        position=trial.position, velocity=trial.velocity, effort=trial.effort,
        command_time=trial.command_time, command=command,
        initial_position=trial.position[0], initial_velocity=velocity,
    )  # fmt: skip
    rows = BatchSimulator([segment], trial.joints, threads=1).simulate(np.array([0]), {})[0]
    moved = replayed.position - trial.position[0]
    return (
        float(np.abs(rows.position - replayed.position).max()),
        float(np.abs(rows.velocity - replayed.velocity).max()),
        float(np.abs(moved).max()),
    )


@pytest.mark.parametrize("mode", SCALE)
@pytest.mark.parametrize("jitter", [0.0, 7e-4], ids=["commands on steps", "commands between steps"])
def test_batch_rows_and_replay_agree_on_a_two_joint_arm(mode: CommandMode, jitter: float) -> None:
    model = mujoco.MjModel.from_xml_string(ARM.format(DRIVES[mode]))
    random = np.random.default_rng(3)
    time = 0.01 * np.arange(120)
    late = time + jitter * random.uniform(size=len(time))
    command = SCALE[mode] * np.column_stack([np.sin(9 * time), np.sign(np.sin(5 * time))])
    begin = 1_700_000_000_000_000_000

    def series(topic: str, at: np.ndarray, **fields: np.ndarray) -> JointSeries:
        stamp = begin + np.rint(at * 1e9).astype(np.int64)
        empty = {"position": None, "velocity": None, "effort": None}
        return JointSeries(topic, ("shoulder", "elbow"), stamp, stamp, **{**empty, **fields})

    trial = make_trial(
        Recording(
            Path("made.mcap"),
            {
                "state": series("/joint_states", time, position=np.zeros((len(time), 2))),
                "command": series("/joint_commands", late, **{mode: command}),
            },
            {},
            (),
        )
    )
    position, velocity, moved = compare_rows_with_replay(model, trial)
    assert moved > 0.1
    assert position < 1e-9
    assert velocity < 1e-8


GRIPPER = """\
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body><joint name="lift" axis="0 1 0" damping=".4"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1" contype="0" conaffinity="0"/>
<body pos=".3 0 0"><joint name="wrist" axis="0 1 0" damping=".2"/>
<geom type="capsule" fromto="0 0 0 .1 0 0" size=".02" mass=".5" contype="0" conaffinity="0"/>
<body pos=".1 0 0"><joint name="finger" type="slide" axis="0 1 0" damping="3"/>
<geom size=".01" mass=".05" contype="0" conaffinity="0"/></body>
<body pos=".1 0 0"><joint name="mirror" type="slide" axis="0 -1 0" damping="3"/>
<geom size=".01" mass=".05" contype="0" conaffinity="0"/></body></body></body>
</worldbody><equality><joint joint1="mirror" joint2="finger"/></equality>
<actuator><position joint="lift" kp="60" kv="2"/><position joint="wrist" kp="30" kv="1" gear="2"/>
<position joint="finger" kp="200" kv="5"/></actuator></mujoco>
"""


GRIPPER_JOINTS, GRIPPER_START = ("lift", "wrist", "finger"), (0.1, 0.3, 0.02)


def gripper_trial(time: np.ndarray, commanded: tuple[str, ...], sent: np.ndarray) -> Trial:
    """A trial in which only the commands and the first state carry information."""
    at = 1_700_000_000_000_000_000 + np.rint(time * 1e9).astype(np.int64)
    start = np.tile(GRIPPER_START, (len(time), 1))
    series = {
        "state": JointSeries("/joint_states", GRIPPER_JOINTS, at, at, start, None, None),
        "command": JointSeries("/joint_commands", commanded, at, at, sent, None, None),
    }
    return make_trial(Recording(Path("made.mcap"), series, {}, ()))


def test_uncommanded_servos_and_mimic_joints_move_the_same_in_rows_and_replay(
    tmp_path: Path,
) -> None:
    """The wrist servo has no command, and one finger follows the other."""
    (tmp_path / "model.xml").write_text(GRIPPER)
    realization = load(tmp_path / "model.xml")
    time = 0.01 * np.arange(120)
    sent = np.column_stack([0.1 + 0.4 * np.sin(9 * time), 0.02 + 0.01 * np.sin(5 * time)])
    joints, commanded = GRIPPER_JOINTS, ("lift", "finger")
    trial = gripper_trial(time, commanded, sent)
    (segment,) = segments_of(realization, trial, 0, joints)
    (rows,) = BatchSimulator([segment], joints, threads=1).simulate(np.array([0]), {})
    replayed = replay(realization, [trial], threads=1)[0]
    assert np.ptp(replayed.position[:, 0]) > 0.1
    assert np.abs(rows.position - replayed.position).max() < 1e-9
    assert np.abs(replayed.position[:, 1] - 0.3).max() < 0.1, (
        "the wrist servo does not hold its first position"
    )
    # Without the state of the unrecorded joints a row moves differently.
    bare = replace(segment, unrecorded=None)
    (other,) = BatchSimulator([bare], joints, threads=1).simulate(np.array([0]), {})
    assert np.abs(other.position - replayed.position)[:, 1].max() > 0.1
    assert np.abs(other.position - replayed.position)[:, 2].max() > 1e-4


REMEMBERING = {
    "filter": (
        "position",
        '<position joint="shoulder" kp="60" kv="2" timeconst=".05"/>'
        '<position joint="elbow" kp="30" kv="1" timeconst=".02"/>',
    ),
    "integrator": (
        "velocity", '<intvelocity joint="shoulder" kp="60"/><intvelocity joint="elbow" kp="30"/>'
    ),
    "delay line": (
        "position",
        '<position joint="shoulder" kp="60" kv="2" delay=".02" nsample="12"/>'
        '<position joint="elbow" kp="30" kv="1"/>',
    ),
}  # fmt: skip


@pytest.mark.parametrize("drives", REMEMBERING)
def test_actuators_with_internal_state_start_as_in_a_replay(tmp_path: Path, drives: str) -> None:
    mode, text = REMEMBERING[drives]
    (tmp_path / "model.xml").write_text(ARM.format(text))
    realization = load(tmp_path / "model.xml")
    time = 0.01 * np.arange(150)
    at = 1_700_000_000_000_000_000 + np.rint(time * 1e9).astype(np.int64)
    joints = ("shoulder", "elbow")
    start = np.tile([0.3, -0.4], (len(time), 1))
    wave = 0.2 * np.sin(6.0 * time)[:, None] * np.ones(2)
    sent = {"position": None, "velocity": None, "effort": None}
    sent[mode] = start + wave if mode == "position" else wave
    series = {
        "state": JointSeries("/joint_states", joints, at, at, start, None, None),
        "command": JointSeries("/joint_commands", joints, at, at, **sent),
    }
    trial = make_trial(Recording(Path("made.mcap"), series, {}, ()))
    (segment,) = segments_of(realization, trial, 0, joints)
    model = dry_friction_as_rows(segment.model, joints)
    replayed = replay_rows([Row(trial, model)], threads=1)[0].position
    (found,) = BatchSimulator([segment], joints, threads=1).simulate(np.array([0]), {})
    assert np.ptp(replayed, axis=0).min() > 0.05
    assert np.abs(found.position - replayed).max() < 1e-9
    # Finer steps would overflow MuJoCo's delay buffer: the delay is simulated as an effect.
    stepped = segments_of(without_delays(realization), trial, 0, joints)
    fixed = fixed_values(effects_outside_mjcf(realization, None), joints, 1)
    coarse, fine = (
        BatchSimulator(stepped, joints, threads=1, refine=refine, fixed=fixed)
        .simulate(np.array([0]), {})[0]
        .position
        for refine in (1, 4)
    )
    assert np.abs(coarse - replayed).max() < 2e-4
    assert np.abs(fine - replayed).max() < 2e-3


def test_a_joint_without_commands_in_a_recording_is_held_there(tmp_path: Path) -> None:
    (tmp_path / "model.xml").write_text(GRIPPER)
    realization = load(tmp_path / "model.xml")
    time = 0.01 * np.arange(120)
    sent = np.tile(GRIPPER_START, (len(time), 1))
    joints = GRIPPER_JOINTS
    trials = [gripper_trial(time, joints, sent), gripper_trial(time, ("lift",), sent[:, :1])]
    segments = [segments_of(realization, t, i, joints)[0] for i, t in enumerate(trials)]
    rows = BatchSimulator(segments, joints, threads=1).simulate(np.arange(2), {})
    for found, t in zip(rows, trials, strict=True):
        replayed = replay(realization, [t], threads=1)[0]
        assert np.abs(found.position - replayed.position).max() < 1e-9


def test_batch_rows_and_replay_agree_on_the_recorded_so101_arm() -> None:
    folder = RECORDINGS / "so101"
    if not folder.is_dir():
        pytest.skip(
            f"no recordings at {folder}: the environment variable TWIN_RECORDINGS says where"
        )
    realization = load(folder / "model.xml")
    path = sorted((folder / "recordings").rglob("*.mcap"))[0]
    trial = make_trial(read_recording(path), realization.structure)
    position, _, moved = compare_rows_with_replay(realization.model, trial)
    assert moved > 0.1
    assert position < 1e-6
