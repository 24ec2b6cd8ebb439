"""Task of an error budget: the pose of one frame, over poses or motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.provenance.poses import draw_poses, poses_of
from pytest_twin.realization import Realization
from pytest_twin.realization.patch import suggest
from pytest_twin.realization.serial_chain import SerialChain, load_serial_chain
from pytest_twin.trial import Trial, make_trials
from pytest_twin.trial.read import recordings_at
from pytest_twin.trial.roles import refuse_final
from pytest_twin.twin import Twin

POSES = 64
"""Largest number of poses over which a displacement is averaged."""
SIMULATED_S = 3.0
"""Longest motion, s. It is simulated once for each parameter and draw."""
_SLOPE_S = 0.05
"""Time over which a velocity is computed from positions. Noise of 1 mrad then becomes 28 mrad/s."""


@dataclass(frozen=True, slots=True)
class Task:
    """Frame, poses and motion of a task.

    Attributes:
        frame: name of the frame.
        frame_source: description of where the frame was declared.
        chain: kinematic chain to the frame.
        readings: (n, j) encoder readings of the chain, rad or m.
        velocity: (n, j) velocities from encoders, rad/s or m/s, or None without known motion.
        source: description of where the readings come from.
        trial: motion with commands, at most ``SIMULATED_S`` long, or None.
        payloads, controllers: names of those that the metadata of the task's recordings state.
    """

    frame: str
    frame_source: str
    chain: SerialChain
    readings: FloatArray
    velocity: FloatArray | None
    source: str
    trial: Trial | None = None
    notes: tuple[str, ...] = ()
    payloads: frozenset[str] = frozenset()
    controllers: frozenset[str] = frozenset()


def task_of(twin: Twin, realization: Realization) -> Task:
    """Return the task that ``budget:`` of a twin declares, or a default task.

    Raises:
        TwinError: the model lacks a frame or a joint, or a recording cannot be read.
    """
    frame, source = _frame(twin, realization)
    chain = load_serial_chain(twin.path, frame)
    spec = twin.budget
    notes: list[str] = []
    trials = _trials(twin, realization, notes)
    if spec.poses:
        readings = _declared_poses(twin, realization, chain)
        found = Task(frame, source, chain, readings, None, f"{len(readings)} declared poses")
    elif trials:
        position, velocity = _instants(trials, chain)
        words = f"{len(position)} instants of {len(spec.recordings)} declared recordings"
        found = Task(frame, source, chain, position, velocity, words)
    else:
        empty = np.zeros((0, len(chain.joints)))
        found = _without_motion(twin, realization, Task(frame, source, chain, empty, None, ""))
    trial = trials[0].until(SIMULATED_S) if trials else None
    return replace(
        found,
        trial=trial,
        notes=tuple(notes),
        payloads=_stated(trials, "payload"),
        controllers=_stated(trials, "controller"),
    )


def _stated(trials: list[Trial], name: str) -> frozenset[str]:
    """Values of one field in the metadata of trials."""
    return frozenset(value for trial in trials if (value := trial.metadata.get(name)))


def _frame(twin: Twin, realization: Realization) -> tuple[str, str]:
    structure = realization.structure
    if twin.budget.frame is not None:
        if twin.budget.frame not in structure.frame_body:
            raise twin.error(
                "budget.frame",
                "the model has no such frame",
                value=twin.budget.frame,
                expected=suggest(twin.budget.frame, tuple(structure.frame_body)),
            )
        return twin.budget.frame, "budget: frame: of twin.yaml"
    if twin.tcp is not None:
        return twin.tcp, "tcp: of twin.yaml"
    deepest = max(structure.body_tree, key=lambda body: len(structure.ancestors(body)), default="")
    if not deepest:
        raise twin.error("model", "no body moves", expected="a robot with joints")
    return deepest, "the end of the longest chain; budget: frame: declares another"


def _declared_poses(twin: Twin, realization: Realization, chain: SerialChain) -> FloatArray:
    known = realization.structure.joint_type
    for at, pose in enumerate(twin.budget.poses):
        for joint in pose:
            if joint not in known:
                raise twin.error(
                    f"budget.poses.{at}.{joint}",
                    "the model has no such joint",
                    value=joint,
                    expected=suggest(joint, tuple(known)),
                )
    return np.array([[pose.get(j, 0.0) for j in chain.joints] for pose in twin.budget.poses])


def _trials(twin: Twin, realization: Realization, notes: list[str]) -> list[Trial]:
    found: list[Trial] = []
    for path in twin.budget.recordings:
        for recording in recordings_at(path, twin.topics, twin.recordings):
            refuse_final(recording.metadata, path, "an error budget")
            commands = recording.series.get("command")
            if commands is None or not len(commands.stamp):
                notes.append(f"{path.name} holds no commands: its poses count, and no motion does")
            else:
                found += make_trials(recording, realization.structure, twin.recordings)
    return found


def _without_motion(twin: Twin, realization: Realization, task: Task) -> Task:
    """Use joint positions of recordings without commands, or else random ones."""
    recordings = [
        one
        for path in twin.budget.recordings
        for one in recordings_at(path, twin.topics, twin.recordings)
    ]
    poses = poses_of(recordings, realization.structure, twin)
    words = f"positions of {len(twin.budget.recordings)} declared recordings"
    if poses is None:
        poses = draw_poses(realization.structure)
        words = "poses drawn within the joints' ranges (seed 0); budget: poses: declares others"
    keep = np.unique(np.linspace(0, len(poses.positions) - 1, POSES).astype(int))
    readings = np.zeros((len(keep), len(task.chain.joints)))
    for column, joint in enumerate(task.chain.joints):
        if joint in poses.joints:
            readings[:, column] = poses.positions[keep, poses.joints.index(joint)]
    return replace(task, readings=readings, source=f"{len(keep)} {words}")


def _instants(trials: Sequence[Trial], chain: SerialChain) -> tuple[FloatArray, FloatArray]:
    """Return positions and velocities of the chain's joints at instants spread over the trials."""
    positions, velocities = [], []
    each = max(2, POSES // len(trials))
    for trial in trials:
        half = 0.5 * _SLOPE_S
        at = np.linspace(trial.time[0] + half, trial.time[-1] - half, each)
        position, velocity = np.zeros((2, each, len(chain.joints)))
        for column, joint in enumerate(chain.joints):
            if joint not in trial.joints:
                continue
            values = trial.position[:, trial.joints.index(joint)]
            known = np.isfinite(values)
            late, early = (
                np.interp(at + side, trial.time[known], values[known]) for side in (half, -half)
            )
            position[:, column] = np.interp(at, trial.time[known], values[known])
            velocity[:, column] = (late - early) / _SLOPE_S
        positions.append(position)
        velocities.append(velocity)
    return np.concatenate(positions), np.concatenate(velocities)


def record_path(path: Path, twin: Twin) -> str:
    """Return the path of a record's file relative to the twin's folder, for ``budget.json``."""
    root = twin.root.resolve()
    resolved = path.resolve()
    return str(resolved.relative_to(root) if resolved.is_relative_to(root) else resolved)
