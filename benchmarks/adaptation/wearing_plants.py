"""Online updates of plants that wear and warm up: test, promote, release and roll back.

    python benchmarks/adaptation/wearing_plants.py [--plants 5] [--recordings 8]

Each plant is a pendulum on a servo with random friction. Its Coulomb friction triples over the
recordings (wear); its viscous friction decreases by 40 % within each, as the gear warms up. The
twin has the initial friction. An update is declared, compared with the release by ``pytest-twin
shadow``, promoted, and the twin is released again. Then a fault is injected: a model with 3.5 times
the damping. The comparison must reject it, and the rollback must restore the twin.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "adaptation"))

import plants

from pytest_twin.adaptation.recursive import Recursion, base_parameters, track
from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.formats.mcap import write_recording
from pytest_twin.formats.recording import JointSeries
from pytest_twin.open_loop import row_of
from pytest_twin.realization import load
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recording_at
from pytest_twin.twin import DEFAULT_TOPICS

GOLDEN = """schema: 1
kind: fk
target: {frames: [arm]}
stimulus: {poses: [reference]}
tolerance: {position: 0.1 mm, orientation: 0.1 mrad}
"""
TWIN = "name: pendulum\nmodel: model.xml\nshadow: {metrics: {position_rms: 0.05}}\n"
UPDATE = """update:
  id: friction-1
  rule: recursive_least_squares
  window: 0.5
  noise: 0.0005
  forgetting: 0.9
  parameters:
    a.viscous_friction: {lower: 0.0, upper: 0.4}
    a.coulomb_friction: {lower: 0.0, upper: 0.2}
"""
SECONDS = 6.0
WARM_S = 2.0
COOLED = 0.4
WORN = 3.0
NOISE = 0.0005
FAULT = 3.5
"""Damping factor of the injected faulty model. It is within the bounds of the update."""


@dataclass(frozen=True)
class Friction:
    """Initial friction of a warm plant: viscous (N*m*s/rad) and Coulomb (N*m)."""

    damping: float
    dry: float


def drawn(seed: int) -> Friction:
    rng = np.random.default_rng(seed)
    return Friction(rng.uniform(0.04, 0.1), rng.uniform(0.01, 0.02))


def record(path: Path, plant: Friction, age: float, phase: float) -> None:
    """Simulate a motion at 100 Hz; ``age`` is from 0 (new) to 1 (worn out)."""
    model = mujoco.MjModel.from_xml_string(plants.model(plant.damping, plant.dry))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(int(1e6 * phase) + round(1e3 * age))
    model.dof_frictionloss[0] = plant.dry * (1.0 + (WORN - 1.0) * age)
    states, commands, times = [], [], []
    for step in range(round(SECONDS / model.opt.timestep)):
        time = step * model.opt.timestep
        warm = 1.0 - np.exp(-time / WARM_S)
        model.dof_damping[0] = plant.damping * (1.0 - COOLED * warm) / (1.0 - COOLED)
        if step % 5 == 0:
            data.ctrl[0] = 0.6 * np.sin(2.0 * time + phase) + 0.3 * np.sin(5.0 * time)
            times.append(time)
            states.append(data.qpos[0] + NOISE * rng.normal())
            commands.append(data.ctrl[0])
        mujoco.mj_step(model, data)
    stamps = np.rint(1e9 * np.array(times)).astype(np.int64) + round((1.0 + age) * 1e18)
    series = [
        JointSeries(topic, ("a",), stamps, stamps, np.array(values)[:, None], None, None)
        for topic, values in (("/joint_states", states), ("/joint_commands", commands))
    ]
    write_recording(path, series, {"command_between": "held"})


def followed(folder: Path, recordings: list[Path]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors of base and update by window (rad), and the parameters after each."""
    realization = load(folder / "model.xml")
    trials = [
        trial
        for path in recordings
        for trial in make_trials(recording_at(path, DEFAULT_TOPICS), realization.structure)
    ]
    rows = [row_of(realization, trial) for trial in trials]
    spec = UpdateSpec(
        "friction-1", {"a.viscous_friction": (0.0, 0.4), "a.coulomb_friction": (0.0, 0.2)},
        window=0.5, noise=NOISE, forgetting=0.9,
    )  # fmt: skip
    windows = track(Recursion(spec, base_parameters(spec, rows[0].model)), rows)
    return (
        np.array([one.base_rms for one in windows]),
        np.array([one.updated_rms for one in windows]),
        np.array([one.parameters for one in windows]),
    )


def told(twin: Path, *words: str) -> int:
    """Run a command in the twin's folder and return its exit status."""
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=twin, capture_output=True, text=True, check=False
    )
    return done.returncode


def gate(twin: Path, flag: str) -> int:
    return told(twin, "pytest", "-p", "no:cacheprovider", "-q", flag)


def tried(folder: Path, seed: int, count: int) -> dict[str, object]:
    """Run one plant from its first release to the rollback."""
    plant = drawn(seed)
    twin = folder / "twin"
    (twin / "golden/fk").mkdir(parents=True)
    (twin / "golden/fk/home.yaml").write_text(GOLDEN)
    (twin / "twin.yaml").write_text(TWIN)
    new = plants.model(plant.damping, plant.dry)
    (twin / "model.xml").write_text(new)
    recordings = []
    for number in range(count):
        recordings.append(folder / f"day{number}.mcap")
        record(recordings[-1], plant, number / (count - 1), 0.7 * number)
    base, update, parameters = followed(twin, recordings)
    late = slice(2 * len(base) // 3, None)
    paths = [str(path) for path in recordings]
    shadow = ("pytest_twin.cli", "shadow")
    assert gate(twin, "--twin-update") == gate(twin, "--twin-release") == 0
    (twin / "twin.yaml").write_text(TWIN + UPDATE)
    promoted = told(twin, *shadow, "releases/0001", ".", *paths, "--promote") == 0
    released = promoted and gate(twin, "--twin-release") == 0
    (twin / "model.xml").write_text(plants.model(FAULT * plant.damping, plant.dry))
    rejected = told(twin, *shadow, "releases/0002", ".", *paths) == 1
    restored = told(twin, "pytest_twin.cli", "rollback") == 0
    back = restored and (twin / "model.xml").read_text() == new
    return {
        "base": 1e3 * float(np.sqrt(np.mean(base[late] ** 2))),
        "update": 1e3 * float(np.sqrt(np.mean(update[late] ** 2))),
        "better": float(np.mean(update[late] < base[late])),
        "dry": (float(parameters[-1, 1]), WORN * plant.dry),
        "steps": (promoted, released, rejected, back),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", type=int, default=5)
    parser.add_argument("--recordings", type=int, default=8)
    args = parser.parse_args()
    print("plant  last third, base -> update [mrad]  better in  Coulomb [N*m] (true)  steps")
    for seed in range(args.plants):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            os.environ["HOME"] = scratch
            for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"):
                os.environ[name] = scratch
            found = tried(folder, seed, args.recordings)
        dry, true = found["dry"]
        names = ("promoted", "released", "fault rejected", "rolled back")
        steps = [name for name, done in zip(names, found["steps"], strict=True) if done]
        error = f"{found['base']:10.2f} -> {found['update']:.2f}"
        better = f"{100 * found['better']:17.0f} %"
        print(f"{seed:5d}  {error}  {better}  {dry:.4f} ({true:.4f})  {', '.join(steps)}")


if __name__ == "__main__":
    main()
