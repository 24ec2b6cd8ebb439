"""Throughput of replaying real recordings, relative to ``mujoco.rollout`` of the same steps.

Run ``python benchmarks/replay_throughput.py``. Both step the same rows (models, initial states,
controls) with the same number of threads. The time of the replay is from trials to predictions,
including the preparation of commands and interpolation. The rollout's controls are prepared
beforehand and not included. The two alternate, so that the load of the machine slows both; the
ratio of CPU times does not depend on it.

Goal: at least 0.9 of the throughput of ``mujoco.rollout``.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np

from pytest_twin.formats.mcap import read_recording
from pytest_twin.open_loop import Row, replay_rows
from pytest_twin.realization import load
from pytest_twin.realization.inputs import command_input
from pytest_twin.trial import Trial, make_trial
from pytest_twin.twin import load_twin

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS")
    or Path(__file__).resolve().parents[2] / "shared" / "recordings"
)
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


def rows_of(name: str) -> list[Row]:
    """All recordings of one set with its model."""
    folder = RECORDINGS / name
    file = folder / "twin.yaml"
    twin = load_twin(file) if file.is_file() else None
    realization = load(folder / "model.xml", twin=twin)
    rows = []
    for path in sorted((folder / "recordings").glob("*.mcap")):
        trial = make_trial(read_recording(path), realization.structure)
        controller = trial.metadata.get("controller") if twin is not None else None
        rows.append(Row(trial, realization.variant(controller).model))
    return rows


def laid_out(rows: Sequence[Row]) -> list[Callable[[mujoco.rollout.Rollout], float]]:
    """Call ``mujoco.rollout`` for each group of rows of similar length."""
    groups: list[list[Row]] = []
    for row in sorted(rows, key=lambda row: row.trial.duration):
        if groups and row.trial.duration <= 1.05 * groups[-1][0].trial.duration:
            groups[-1].append(row)
        else:
            groups.append([row])
    return [_rollout(group) for group in groups]


def _rollout(rows: Sequence[Row]) -> Callable[[mujoco.rollout.Rollout], float]:
    models = [row.model for row in rows]
    steps = [steps_of(row.trial, row.model) for row in rows]
    states = np.empty((len(rows), mujoco.mj_stateSize(models[0], FULL)))
    controls = np.zeros((len(rows), max(steps), models[0].nu))
    for i, row in enumerate(rows):
        model, trial = row.model, row.trial
        data = mujoco.MjData(model)
        at = np.arange(max(steps)) * model.opt.timestep
        held = np.maximum(np.searchsorted(trial.command_time, at, side="right") - 1, 0)
        for column, joint in enumerate(trial.joints):
            index = model.joint(joint).qposadr[0]
            data.qpos[index] = trial.position[0, column]
        for column, joint in enumerate(trial.command_joints):
            target = command_input(model, joint, trial.command_mode)
            assert target is not None
            controls[i, :, target.control] = target.scale * trial.command[held, column]
        mujoco.mj_getState(model, data, states[i], FULL)

    def run(pool: mujoco.rollout.Rollout) -> float:
        threads = max(1, pool.nthread)
        pool.rollout(models, [mujoco.MjData(models[0]) for _ in range(threads)], states, controls)
        return float(len(rows) * max(steps))

    return run


def steps_of(trial: Trial, model: mujoco.MjModel) -> int:
    """Number of steps from the first state to the last."""
    return int(trial.duration / model.opt.timestep) + 1


def measure(name: str, threads: int, repeats: int) -> None:
    """Print the throughputs of both, and their ratio round by round."""
    rows = rows_of(name)
    own_steps = float(sum(steps_of(row.trial, row.model) for row in rows))
    calls = laid_out(rows)
    ours, theirs = [], []
    with mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0) as pool:
        for repeat in range(repeats + 1):
            begin = _clocks()
            replay_rows(rows, threads=threads)
            middle = _clocks()
            stepped = sum(call(pool) for call in calls)
            end = _clocks()
            if repeat > 0:  # the first round is a warm-up
                ours.append(own_steps / (middle - begin))
                theirs.append(stepped / (end - middle))
    ratios = np.array(ours) / np.array(theirs)
    lowest, median = ratios.min(axis=0), np.median(ratios, axis=0)
    print(
        f"{name:6} {len(rows):3} recordings, {own_steps:9.0f} steps, {threads} threads: replay "
        f"{np.median(ours, axis=0)[0]:9.0f} steps/s, rollout {np.median(theirs, axis=0)[0]:9.0f}; "
        f"ratio min {lowest[0]:.2f}, median {median[0]:.2f} "
        f"(by CPU time {lowest[1]:.2f}, {median[1]:.2f})"
    )


def _clocks() -> np.ndarray:
    """Wall time, and CPU time of all threads, s."""
    return np.array([time.perf_counter(), time.process_time()])


def main() -> int:
    """Measure each set with one thread and with two."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", nargs="+", default=["so101", "xl330", "emps"])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    if not RECORDINGS.is_dir():
        print(f"no recordings at {RECORDINGS}: TWIN_RECORDINGS says where", file=sys.stderr)
        return 2
    for name in arguments.sets:
        for threads in arguments.threads:
            measure(name, threads, arguments.repeats)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
