"""Throughput of simulating many random robots, relative to ``mujoco.rollout``.

    python benchmarks/randomization/throughput.py [--draws 10000] [--engine-rows 256]

A six-joint arm with position servos, uncertain friction, armature and masses, follows a command for
12 s. One call of `pytest-twin randomize` draws and simulates all robots. ``mujoco.rollout`` steps
models that were built beforehand, with the same number of threads; its time per step is measured
with fewer rows.

Goal: at least 0.5 of the throughput of ``mujoco.rollout``, including drawing, writing of models,
batches and reading of sensors.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import mujoco
import mujoco.rollout
import numpy as np

from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.ranges.ranges_of_twin import ranges_of_file
from pytest_twin.realization.forks import usable_cores

JOINTS = tuple(f"joint{k + 1}" for k in range(6))
LENGTHS = (0.1, 0.4, 0.35, 0.1, 0.1, 0.05)
MASSES = (4.0, 6.0, 3.0, 1.5, 1.0, 0.3)
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
RATE, SECONDS = 100, 12.0
KINDS = {"viscous_friction": (1.0, 0.2), "coulomb_friction": (0.3, 0.06), "armature": (0.1, 0.02)}
UNITS = ("N*m*s/rad", "N*m", "kg*m^2")


def model_text() -> str:
    """Return the arm as MJCF."""
    bodies = ""
    for k, (length, mass, axis) in enumerate(zip(LENGTHS, MASSES, AXES, strict=True)):
        before = LENGTHS[k - 1] if k else 0.0
        place = f"{before} 0 0" if k > 1 else f"0 0 {before}"
        moment = 0.05 * mass * (0.05 + length) ** 2 + 1e-4
        bodies += (
            f'<body name="link{k + 1}" pos="{place}"><inertial pos="{0.5 * length} 0 0" '
            f'mass="{mass}" diaginertia="{moment} {moment} {moment}"/><joint name="{JOINTS[k]}" '
            f'axis="{axis}" damping="1" frictionloss="0.3" armature="0.1"/>'
        )
    drives = "".join(f'<position joint="{j}" kp="200" kv="20"/>' for j in JOINTS)
    return (
        '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
        f"{bodies}{'</body>' * 6}</worldbody><actuator>{drives}</actuator></mujoco>"
    )


def twin(folder: Path) -> Path:
    """Write a twin with a record, and one final recording of 12 s."""
    (folder / "arm.xml").write_text(model_text())
    names = [f"{joint}.{kind}" for joint in JOINTS for kind in KINDS]
    std = [s for _ in JOINTS for _, s in KINDS.values()]
    parameters = {
        f"{joint}.{kind}": {"value": m, "unit": unit, "ci95": [m - 1.96 * s, m + 1.96 * s]}
        for joint in JOINTS
        for (kind, (m, s)), unit in zip(KINDS.items(), UNITS, strict=True)
    }
    record = {
        "schema": 1, "identification": "fit", "verdict": "accepted", "parameters": parameters,
        "stages": [], "held_out": {joint: {"effort_relative": 0.1} for joint in JOINTS},
        "covariance": {"names": names, "matrix": np.diag(np.square(std)).tolist()},
        "trials": {"fit": [], "held_out": []}, "fit": {},
    }  # fmt: skip
    (folder / "fit.json").write_text(json.dumps(record))
    tolerances = "".join(f"  - {{parameter: link{k + 1}.mass, relative: 0.05}}\n" for k in range(6))
    (folder / "twin.yaml").write_text(
        "model: arm.xml\nfit:\n- {file: fit.json}\nranges:\n  tolerance:\n" + tolerances
    )
    model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    controls = commands(model)
    data = mujoco.MjData(model)
    every = round(1.0 / RATE / model.opt.timestep)
    position = []
    for step, control in enumerate(controls):
        if step % every == 0:
            position.append(data.qpos.copy())
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
    read = np.array(position) + 1e-5 * np.random.default_rng(1).standard_normal((len(position), 6))
    stamps = (1e9 / RATE * np.arange(len(read))).astype(np.int64) + 10**18
    (folder / "recordings").mkdir()
    series = [
        JointSeries("/joint_states", JOINTS, stamps, stamps, read, None, None),
        JointSeries("/joint_commands", JOINTS, stamps, stamps, controls[::every], None, None),
    ]
    metadata = {"role": "final", "command_between": "held"}
    write_recording(folder / "recordings/final.mcap", series, metadata)
    return folder / "twin.yaml"


def commands(model: mujoco.MjModel) -> np.ndarray:
    """(steps, 6) smooth positions, held between the stamps of the recording."""
    steps = round(SECONDS / model.opt.timestep)
    every = round(1.0 / RATE / model.opt.timestep)
    at = model.opt.timestep * (np.arange(steps) // every * every)
    phases = np.arange(1, 7)
    return 0.5 * np.sin(0.5 * phases * at[:, None]) * np.minimum(1.0, at)[:, None]


def engine(folder: Path, rows: int, threads: int) -> float:
    """Return the steps per second of ``mujoco.rollout`` with different models."""
    model = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
    random = np.random.default_rng(2)
    models = []
    for _ in range(rows):
        one = mujoco.MjModel.from_xml_path(str(folder / "arm.xml"))
        one.dof_damping[:] *= random.uniform(0.8, 1.2, 6)
        one.body_mass[:] *= random.uniform(0.95, 1.05, 7)
        mujoco.mj_setConst(one, mujoco.MjData(one))
        models.append(one)
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    states = np.zeros((rows, mujoco.mj_stateSize(model, full)))
    controls = np.repeat(commands(model)[None], rows, axis=0)
    with mujoco.rollout.Rollout(nthread=threads) as rollout:
        data = [mujoco.MjData(model) for _ in range(threads)]
        started = time.perf_counter()
        rollout.rollout(models, data, states, controls)
        seconds = time.perf_counter() - started
    return controls.shape[0] * controls.shape[1] / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--engine-rows", type=int, default=256)
    args = parser.parse_args()
    threads = usable_cores()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        path = twin(folder)
        before = engine(folder, args.engine_rows, threads)
        started = time.perf_counter()
        found = ranges_of_file(str(path), {"draws": args.draws})
        whole = time.perf_counter() - started
        after = engine(folder, args.engine_rows, threads)
    own = found["throughput"]["steps_per_second"]
    rate = 0.5 * (before + after)
    seconds = found["throughput"]["seconds"]
    print(f"{args.draws} robots of six joints, {SECONDS:.0f} s each, {threads} threads")
    print(f"{seconds:.1f} s to simulate them, {whole:.1f} s for the whole command")
    print(f"{own:.3g} steps/s; mujoco.rollout {before:.3g} and {after:.3g} before and after")
    print(f"ratio {own / rate:.2f} (goal: 0.5)")


if __name__ == "__main__":
    main()
