"""Ranges of a real servo: identified at three gains, checked at a fourth, unused gain.

    python benchmarks/randomization/xl330.py [--out DIR]

Needs the recordings (``TWIN_RECORDINGS``, default ``../shared/recordings`` beside the checkout).
Gains 100, 200 and 800 are fitted and held out; the recordings at gain 400 are final. Prints the
mean absolute error of the identified servo for each of these, and how the ranges cover them.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from pytest_twin import cli
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import make_trials
from pytest_twin.trial.read import recordings_at
from pytest_twin.twin import load_twin

RECORDINGS = Path(
    os.environ.get("TWIN_RECORDINGS") or Path(__file__).resolve().parents[3] / "shared/recordings"
)
FIT = [
    f"kp{gain}_{motion}" for gain in (100, 200, 800) for motion in ("sin_sin", "sin_time_square")
]
HELD_OUT = ["kp100_up_and_down", "kp200_up_and_down", "kp800_up_and_down"]
FINAL = ["kp400_sin_sin", "kp400_sin_time_square", "kp400_up_and_down"]


def checked(folder: Path, draws: int) -> dict:
    """``ranges.json`` of the servo."""
    source = RECORDINGS / "xl330"
    for name in ("model.xml", "twin.yaml"):
        shutil.copy(source / name, folder / name)
    roles = (("fit", FIT), ("held_out", HELD_OUT), ("final", FINAL))
    paths = {
        role: [str(source / f"recordings/{name}.mcap") for name in names] for role, names in roles
    }
    if not (folder / "fit/identification.json").is_file():
        cli.main([
            "identify", str(folder / "twin.yaml"), *paths["fit"], "--held-out", *paths["held_out"],
            "--out", str(folder / "fit"),
        ])  # fmt: skip
    twin = (source / "twin.yaml").read_text().replace("model: model.xml", "model: fit")
    ranged = folder / "ranged"
    ranged.mkdir(exist_ok=True)
    shutil.copytree(folder / "fit", ranged / "fit", dirs_exist_ok=True)
    (ranged / "twin.yaml").write_text(twin + "fit:\n  - {file: fit/identification.json}\n")
    cli.main([
        "randomize", str(ranged), "--final", *paths["final"], "--held-out", *paths["held_out"],
        "--draws", str(draws), "--out", str(folder / "ranges"),
    ])  # fmt: skip
    found: dict = json.loads((folder / "ranges/ranges.json").read_text())
    return found


def final_errors(fitted: Path) -> dict[str, float]:
    """Mean absolute position error of the identified servo, in mrad, by final recording."""
    found = load_model(find_model(fitted))
    assert found.patched is not None
    topics = load_twin(RECORDINGS / "xl330/twin.yaml").topics
    errors = {}
    for name in FINAL:
        (recording,) = recordings_at(RECORDINGS / f"xl330/recordings/{name}.mcap", topics)
        (trial,) = make_trials(recording, found.realization.structure)
        (predicted,) = replay_patched(found.realization, found.patched, [trial], threads=1)
        columns = [trial.joints.index(joint) for joint in found.patched.joints]
        off = predicted.position - trial.position[:, columns]
        errors[name] = 1e3 * float(np.mean(np.abs(off)))
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="kept, with its identification, if given")
    parser.add_argument("--draws", type=int, default=256)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.out or Path(scratch)
        folder.mkdir(exist_ok=True, parents=True)
        check = checked(folder, args.draws)["check"]
        errors = final_errors(folder / "fit")
    each = ", ".join(f"{name} {error:.1f}" for name, error in errors.items())
    print(f"mean absolute error of the identified servo [mrad]: {each}, "
          f"mean {np.mean(list(errors.values())):.1f}")  # fmt: skip
    print(f"coverage {100 * check['coverage']:.1f} %, {check['width_over_tightest']:.2f} times the "
          f"tightest that covers: {check['verdict']}")  # fmt: skip


if __name__ == "__main__":
    main()
