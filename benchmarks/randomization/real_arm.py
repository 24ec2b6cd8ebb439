"""Ranges of a real six-joint arm: identified and widened on some motions, checked on others.

    python benchmarks/real/so101.py --by identify --out DIR
    python benchmarks/randomization/real_arm.py --identified DIR/identified --out DIR/ranges

The first command identifies the arm from eight seconds of three motions, with two held out. The
second one widens its ranges by these two, and checks them on four motions that guided nothing.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "real"))

from so101 import HELD_OUT, excerpt

from pytest_twin import cli

FINAL = ("wave_motion", "spiral_motion", "triangle_wave", "single_joint_elbow")


def checked(identified: Path, folder: Path, seconds: float, draws: int) -> dict:
    """``ranges.json`` of the arm."""
    twin = folder / "twin"
    shutil.copytree(identified, twin / "fit", dirs_exist_ok=True)
    (twin / "twin.yaml").write_text(
        "name: so101\nmodel: fit\nfit:\n  - {file: fit/identification.json}\n"
    )
    paths = {
        role: [str(excerpt(name, role, seconds, folder / "excerpts")) for name in names]
        for role, names in (("held_out", HELD_OUT), ("final", FINAL))
    }
    cli.main([
        "randomize", str(twin), "--final", *paths["final"], "--held-out", *paths["held_out"],
        "--draws", str(draws), "--out", str(folder / "checked"),
    ])  # fmt: skip
    found: dict = json.loads((folder / "checked/ranges.json").read_text())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--identified", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--draws", type=int, default=64)
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True, parents=True)
    check = checked(args.identified, args.out, args.seconds, args.draws)["check"]
    print(f"coverage {100 * check['coverage']:.1f} %, {check['width_over_tightest']:.2f} times the "
          f"tightest that covers: {check['verdict']}")  # fmt: skip
    for joint, one in check["joints"].items():
        print(f"  {joint}: coverage {100 * one['coverage']:.1f} %, envelope "
              f"{1e3 * one['width']:.1f} mrad, motion {1e3 * one['motion']:.0f} mrad")  # fmt: skip


if __name__ == "__main__":
    main()
