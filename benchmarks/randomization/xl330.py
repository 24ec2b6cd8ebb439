"""Ranges of a real servo: identified at three gains, checked at a fourth, unused gain.

    python benchmarks/randomization/xl330.py [--out DIR]

Needs the recordings (``TWIN_RECORDINGS``, default ``../shared/recordings`` beside the checkout).
Gains 100, 200 and 800 are fitted and held out; the recordings at gain 400 are final.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
from pathlib import Path

from pytest_twin import cli

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="kept, with its identification, if given")
    parser.add_argument("--draws", type=int, default=256)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.out or Path(scratch)
        folder.mkdir(exist_ok=True, parents=True)
        check = checked(folder, args.draws)["check"]
    print(f"coverage {100 * check['coverage']:.1f} %, {check['width_over_tightest']:.2f} times the "
          f"tightest that covers: {check['verdict']}")  # fmt: skip


if __name__ == "__main__":
    main()
