"""Replay recordings with an export in its own simulator, in another Python environment."""

from __future__ import annotations

import copy
import json
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.layout import Layout
from pytest_twin.errors import SpecError
from pytest_twin.export.measure import Errors, errors_of
from pytest_twin.export.mujoco_replay import at_stamps
from pytest_twin.open_loop import Row, RowSimulation, row_of
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial

MOST_SECONDS = 20.0
"""Largest total length of the recordings that are stepped there, s: mjlab takes about 2 ms for a
step on a CPU."""
TIMEOUT = 900.0
"""Time limit of one replay of all recordings, s; the first compiles the simulator's kernels."""
_STEPPERS = Path(__file__).with_name("steppers")
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def check_engine(engine: Path, realization: Realization, trials: Sequence[Trial]) -> None:
    """Check that recordings can be replayed in another simulator.

    Raises:
        SpecError: they cannot.
    """
    model = realization.model
    if not engine.is_file():
        raise SpecError(
            "no such Python", where="--engine", value=str(engine),
            expected="the Python of an environment with the simulator's package",
        )  # fmt: skip
    if not np.isin(model.jnt_type, _SCALAR).all():
        raise SpecError(
            "a robot with a floating base is not replayed in another simulator", where="--engine",
            path=realization.path, expected="hinges and slides only, or none of --engine",
        )  # fmt: skip
    for trial in trials:
        named = [key for key in ("controller", "payload") if trial.metadata.get(key)]
        if named:
            raise SpecError(
                f"a recording with its own {named[0]} is not replayed in another simulator",
                path=trial.path, where="metadata", value=trial.metadata[named[0]],
                expected="--held-out recordings of the model as it is exported",
            )  # fmt: skip


def engine_errors(
    engine: Path,
    stepper: str,
    folder: Path,
    realization: Realization,
    trials: Sequence[Trial],
    divisor: int,
) -> Errors:
    """Errors of an export on recordings, in its own simulator.

    Args:
        engine: Python of its environment.
        stepper: script in ``steppers``.
        folder: the export.
        realization: the diagnosed model.
        trials: the recordings.
        divisor: number of the simulator's steps in one step of the model.

    Raises:
        SpecError: the simulator stopped, or takes longer than ``TIMEOUT``.
    """
    runs, motions = [], []
    timestep = float(realization.model.opt.timestep) / divisor
    joints = [realization.model.joint(j).name for j in range(realization.model.njnt)]
    modes: list[str] = []
    for trial in trials:
        row = row_of(realization, trial)
        model = copy.copy(row.model)
        model.opt.timestep = timestep
        run = RowSimulation(
            Row(row.trial, model, row.calibration, row.source), mujoco.MjData(model)
        )
        commands, modes = _joint_commands(model, joints, run)
        runs.append(run)
        motions.append({
            "position": run.initial["qpos"].tolist(),
            "velocity": run.initial["qvel"].tolist(),
            "commands": commands.tolist(),
        })  # fmt: skip
    document = {"timestep": timestep, "joints": joints, "modes": modes, "motions": motions}
    predicted = []
    for run, positions in zip(runs, _run(engine, stepper, folder, document), strict=True):
        columns = [joints.index(joint) for joint in run.trial.joints]
        read = run.encoders.read_position(at_stamps(positions[:, columns], run))
        predicted.append(dict(zip(run.trial.joints, read.T, strict=True)))
    return errors_of(trials, predicted)


def _joint_commands(
    model: mujoco.MjModel, joints: Sequence[str], run: RowSimulation
) -> tuple[FloatArray, list[str]]:
    """(steps, joints) commands at the joints, and the mode of each, empty without a drive."""
    layout = Layout.of_model(model, joints)
    controls = np.empty((run.steps, model.nu + model.nv))
    run.controls(0, run.steps, controls)
    commands, modes = np.zeros((run.steps, len(joints))), []
    for column in range(len(joints)):
        at, mode = int(layout.actuator[column]), str(layout.servo[column])
        modes.append(mode if at >= 0 else "")
        if at >= 0:
            gear = float(layout.gear[column])
            scale = gear * float(model.actuator_gainprm[at, 0]) if mode == "effort" else 1.0 / gear
            commands[:, column] = controls[:, at] * scale
    return commands, modes


def _run(
    engine: Path, stepper: str, folder: Path, document: Mapping[str, object]
) -> list[FloatArray]:
    with tempfile.TemporaryDirectory() as place:
        motions, result = Path(place) / "motions.json", Path(place) / "result.json"
        motions.write_text(json.dumps(document, allow_nan=False))
        # Isolated: that environment has its own versions of the packages here.
        script = [str(engine), "-I", str(_STEPPERS / stepper)]
        command = [*script, str(folder), str(motions), str(result)]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            raise SpecError(
                f"the simulator took more than {TIMEOUT:.0f} s", where="--engine",
                value=str(engine), expected="shorter --held-out recordings",
            ) from None  # fmt: skip
        if done.returncode != 0 or not result.is_file():
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise SpecError(
                f"the simulator stopped: {last}", where="--engine", value=str(engine),
                expected="an environment with the simulator's package",
            )  # fmt: skip
        return [np.array(p, dtype=np.float64) for p in json.loads(result.read_text())["positions"]]
