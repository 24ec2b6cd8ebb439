"""Online update of friction and drive on real servos, in the order of the recordings.

    python benchmarks/real/online_update.py RECORDINGS [SET...] [--friction-alone] [--release]

RECORDINGS is the folder with ``xl330`` and ``so101``. Each window of 0.5 s is predicted from its
first measured state before it updates the parameters. Both columns are over the same windows.

All recordings of a set begin at the same stamp, so their order is not in the files. Those of
``xl330`` are ordered by the temperature of the servo, which rises from 28 to 39 deg C; those of
``so101`` by name.

With ``--friction-alone`` the torque constants are fixed.

With ``--release`` the commands do it: the twin is released, the update is declared and compared by
``pytest-twin shadow``, promoted and released; then a model with 3.5 times the damping is compared,
and ``rollback`` restores the twin.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "adaptation"))

from wearing_plants import FAULT, GOLDEN, gate, told

from pytest_twin.adaptation.recursive import Recursion, base_parameters, track
from pytest_twin.adaptation_spec import UpdateSpec
from pytest_twin.open_loop import row_of
from pytest_twin.realization import load
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recordings_at
from pytest_twin.twin import DEFAULT_TOPICS, load_twin

WINDOW = 0.5
BOUNDS = {
    "xl330": {
        "viscous_friction": (0.0, 0.3), "coulomb_friction": (0.0, 0.2),
        "torque_constant": (-0.6, 0.6),
    },
    "so101": {
        "viscous_friction": (0.0, 3.0), "coulomb_friction": (0.0, 0.5),
        "torque_constant": (-0.99, 0.5),
    },
}  # fmt: skip
MOST_RECORDINGS = {"xl330": 16, "so101": 2}
FRAME = {"xl330": "arm", "so101": "gripper"}


def ordered(folder: Path, name: str, topics: dict[str, str]) -> list[Path]:
    """Recordings of a set in the order in which they are used."""
    paths = sorted((folder / "recordings").iterdir())

    def temperature(path: Path) -> float:
        (recording,) = recordings_at(path, topics)
        return float(recording.metadata.get("temperature", 0.0))

    return sorted(paths, key=temperature)[: MOST_RECORDINGS[name]]


def parameters_of(
    joints: tuple[str, ...], name: str, fixed: tuple[str, ...] = ()
) -> dict[str, tuple[float, float]]:
    return {
        f"{joint}.{kind}": span
        for joint in joints
        for kind, span in BOUNDS[name].items()
        if kind not in fixed
    }


def run(folder: Path, name: str, fixed: tuple[str, ...] = ()) -> None:
    """Print the errors of base and update for one set."""
    twin = load_twin(folder / "twin.yaml") if (folder / "twin.yaml").is_file() else None
    realization = load(folder / "model.xml", twin=twin)
    topics = DEFAULT_TOPICS if twin is None else twin.topics
    trials = [
        trial
        for path in ordered(folder, name, topics)
        for recording in recordings_at(path, topics)
        for trial in make_trials(recording, realization.structure)
    ]
    rows = [row_of(realization, trial) for trial in trials]
    parameters = parameters_of(trials[0].command_joints, name, fixed)
    spec = UpdateSpec(name, parameters, window=WINDOW)
    recursion = Recursion(spec, base_parameters(spec, rows[0].model))
    began = time.perf_counter()
    windows = track(recursion, rows)
    seconds = time.perf_counter() - began
    base = np.array([w.base_rms for w in windows])
    update = np.array([w.updated_rms for w in windows])
    print(f"{name}: {len(trials)} trials, {len(windows)} windows, {seconds:.0f} s")
    for title, of in (
        ("root mean square", lambda v: np.sqrt(np.mean(v**2))),
        ("median", np.median),
    ):
        was, now = 1e3 * of(base), 1e3 * of(update)
        print(f"  {title}: {was:.2f} -> {now:.2f} mrad ({100 * (now / was - 1):+.1f} %)")
    better = float(np.mean(update < base))
    worst = f"{1e3 * base.max():.1f} -> {1e3 * update.max():.1f} mrad"
    print(f"  better in {100 * better:.0f} % of the windows, worst window {worst}")
    for at, parameter in enumerate(parameters):
        print(f"  {parameter}: {recursion.base[at]:.4g} -> {recursion.value[at]:.4g}")


def through_releases(source: Path, name: str, scratch: Path) -> None:
    """Print what each command of the way from the first release to the rollback answered."""
    folder = scratch / name
    (folder / "golden/fk").mkdir(parents=True)
    (folder / "golden/fk/home.yaml").write_text(GOLDEN.replace("arm", FRAME[name]))
    shutil.copy(source / "model.xml", folder)
    own = source / "twin.yaml"
    text = own.read_text() if own.is_file() else "model: model.xml\n"
    text += f"name: {name}\nshadow: {{metrics: {{position_rms: 0.02}}}}\n"
    (folder / "twin.yaml").write_text(text)
    paths = [str(path) for path in ordered(source, name, load_twin(folder / "twin.yaml").topics)]
    nominal = (folder / "model.xml").read_text()
    print(
        f"{name}: released {gate(folder, '--twin-update') == gate(folder, '--twin-release') == 0}"
    )
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    joints = tuple(model.joint(joint).name for joint in range(model.njnt))
    bounds = {
        key: {"lower": low, "upper": high}
        for key, (low, high) in parameters_of(joints, name).items()
    }
    update = {"id": "drive-1", "rule": "recursive_least_squares", "window": WINDOW,
              "parameters": bounds}  # fmt: skip
    (folder / "twin.yaml").write_text(f"{text}update: {json.dumps(update)}\n")
    shadow = ("pytest_twin.cli", "shadow")
    status = told(folder, *shadow, "releases/0001", ".", *paths, "--promote", "--json", "out.json")
    found = json.loads((folder / "out.json").read_text())
    print(f"  shadow of release 1: status {status}, {found['verdict']}")
    for one in found["metrics"]:
        print(f"    {one['metric']}: {100 * one['change']:+.1f} %, met {one['met']}")
    for one in found["faults"]:
        print(f"    {one['fault']}: {one['why']}")
    if status == 0:
        print(f"  released with the update: {gate(folder, '--twin-release') == 0}")
    newest = max((folder / "releases").iterdir()).name
    spec = mujoco.MjSpec.from_string(nominal)
    for joint in spec.joints:
        joint.damping[0] *= FAULT
    (folder / "model.xml").write_text(spec.to_xml())
    status = told(folder, *shadow, f"releases/{newest}", ".", *paths)
    print(f"  {FAULT} times the damping: status {status} (1: rejected)")
    restored = told(folder, "pytest_twin.cli", "rollback") == 0
    same = (folder / "model.xml").read_text() == nominal
    print(f"  rollback: {restored}, the model is the released one again: {same}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("sets", nargs="*", default=list(BOUNDS))
    parser.add_argument("--friction-alone", action="store_true")
    parser.add_argument("--release", action="store_true")
    args = parser.parse_args()
    fixed = ("torque_constant",) if args.friction_alone else ()
    if not args.release:
        for which in args.sets:
            run(args.recordings / which, which, fixed)
        return
    with tempfile.TemporaryDirectory() as scratch:
        for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME"):
            os.environ[name] = scratch
        for which in args.sets:
            through_releases((args.recordings / which).absolute(), which, Path(scratch))


if __name__ == "__main__":
    main()
