"""Test whether findings depend on the order of joints or on the unit of length.

The cheaper invariances (order of recordings, shift of all stamps, reversed joint axis) are in the
test suite. These take one to two minutes on an idle core.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.diagnosis.diagnose import Diagnosis, diagnose
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.formats.mcap import JointSeries, read_recording, write_recording
from pytest_twin.loaded_model import load_model
from pytest_twin.trial import make_trial

Array = NDArray[np.float64]
STEP, SECONDS, NOISE = 1e-4, 2.4, 5e-6
MASS, DAMPING, KP, KV = 0.8, 4.0, 400.0, 8.0
HIDDEN = {"first": 1.2, "second": 0.0}
"""Dry friction of each slide, which the model lacks, N."""


def mjcf(joints: Sequence[str], unit: float) -> str:
    """Return a model of parallel horizontal slides, with lengths in units of ``unit`` m."""
    bodies = "".join(
        f'<body name="{j}_link" pos="0 {0.2 * k / unit} 0"><inertial pos="0 0 0" mass="{MASS}" '
        f'diaginertia="{1e-3 / unit**2} {1e-3 / unit**2} {1e-3 / unit**2}"/>'
        f'<joint name="{j}" type="slide" axis="1 0 0" damping="{DAMPING}"/></body>'
        for k, j in enumerate(sorted(joints))
    )
    servos = "".join(f'<position name="{j}" joint="{j}" kp="{KP}" kv="{KV}"/>' for j in joints)
    return (
        f'<mujoco model="slides"><option timestep="0.002" integrator="implicitfast" '
        f'gravity="0 0 {-9.81 / unit}"/><worldbody>{bodies}</worldbody>'
        f"<actuator>{servos}</actuator></mujoco>"
    )


def moved(wanted: Array, dry: float) -> Array:
    """(steps,) position of one slide under setpoints, m, integrated semi-implicitly at 10 kHz."""
    q = v = 0.0
    out = np.empty_like(wanted)
    for k, setpoint in enumerate(wanted):
        out[k] = q
        v += STEP * (KP * (setpoint - q) - (KV + DAMPING) * v) / MASS
        v = np.sign(v) * max(abs(v) - STEP * dry / MASS, 0.0)
        q += STEP * v
    return out


def recorded(folder: Path, joints: Sequence[str], unit: float = 1.0) -> list[Path]:
    """Write model and three recordings, with joints in this order and lengths in ``unit`` m."""
    folder.mkdir()
    (folder / "model.xml").write_text(mjcf(joints, unit))
    time = STEP * np.arange(round(SECONDS / STEP))
    sent, seen = np.arange(0, len(time), 100), np.arange(0, len(time), 50)
    paths = []
    for seed in (1, 2, 3):
        wanted, read = [], []
        for joint in joints:
            rng = np.random.default_rng([seed, sorted(HIDDEN).index(joint)])
            f, phase = rng.uniform(0.3, 1.8, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
            wave = 0.02 * np.sin(2.0 * np.pi * time[:, None] * f + phase).sum(axis=1)
            held = (wave * np.minimum(time / 0.5, 1.0))[(np.arange(len(time)) // 100) * 100]
            noise = NOISE * rng.standard_normal(len(seen))
            wanted.append(held[sent] / unit)
            read.append((moved(held, HIDDEN[joint])[seen] + noise) / unit)
        stamps = [(1e9 * STEP * at).astype(np.int64) + 1_700_000_000_000_000_000
                  for at in (sent, seen)]  # fmt: skip
        names = tuple(joints)
        path = folder / f"{seed}.mcap"
        write_recording(path, [
            JointSeries("/joint_commands", names, stamps[0], stamps[0], np.array(wanted).T, None,
                        None),
            JointSeries("/joint_states", names, stamps[1], stamps[1], np.array(read).T, None, None),
        ], {})  # fmt: skip
        paths.append(path)
    return paths


def diagnosed(paths: Sequence[Path]) -> Diagnosis:
    """Diagnose with the last recording held out."""
    realization = load_model(paths[0].with_name("model.xml")).realization
    trials = [make_trial(read_recording(p), realization.structure) for p in paths]
    return diagnose(realization, TrialSet(tuple(trials[:-1]), (trials[-1],), ()), threads=1)


def differences(a: Diagnosis, b: Diagnosis, scale: float) -> list[str]:
    """Return differences of two diagnoses; ``scale`` is the second's value for 1 N of the first."""
    found: list[str] = []
    if a.verdict != b.verdict:
        found.append(f"verdict: {a.verdict}, then {b.verdict}")
    first, second = ({(f.effect, f.joint): f for f in d.explanation.findings} for d in (a, b))
    if first.keys() != second.keys():
        found.append(f"findings: {sorted(first)}, then {sorted(second)}")
    for key in first.keys() & second.keys():
        for name, one in first[key].parameters.items():
            other = second[key].parameters[name]
            factor = scale if one.unit == "N" else 1.0
            if abs(other.value / factor - one.value) > 0.25 * (one.high - one.low):
                found.append(f"{key} {name}: {one.value:g}, then {other.value / factor:g}")
    return found


def main() -> int:
    """Print the differences; return 1 if there are any."""
    bad = 0
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        usual = diagnosed(recorded(folder / "m", ["first"]))
        millimetres = diagnosed(recorded(folder / "mm", ["first"], unit=1e-3))
        both = diagnosed(recorded(folder / "order", ["first", "second"]))
        swapped = diagnosed(recorded(folder / "swapped", ["second", "first"]))
    for name, pair in {
        "m and mm": (usual, millimetres, 1000.0),
        "order of joints": (both, swapped, 1.0),
    }.items():
        said = differences(*pair)
        names = [(f.effect, f.joint) for f in pair[0].explanation.findings]
        print(f"{name}: {names}: {'the same' if not said else '; '.join(said)}")
        bad += bool(said)
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main())
