"""Held-out errors of the cube tosses, with MuJoCo's defaults and with identified parameters.

    python benchmarks/contact/cube_tosses.py [--tosses FILE.npz] [--cone pyramidal|elliptic]

Prints one table. Errors are means over the samples of a whole toss, then over the held-out tosses
(every fourth): position in percent of the cube's width, rotation in degrees, as the authors of
ContactNets plot them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

BESIDE = Path(__file__).parents[3] / "shared/recordings"
RECORDINGS = Path(os.environ.get("TWIN_RECORDINGS", BESIDE))
# Half width, mass and inertia from DAIRLab/contact-nets.
MODEL = """<mujoco model="cube">
  <option cone="{cone}"/>
  <worldbody>
    <geom name="table" type="plane" size="5 5 0.1"/>
    <body name="cube" pos="0 0 0.2"><freejoint/>
      <inertial pos="0 0 0" mass="0.37" diaginertia="0.00081 0.00081 0.00081"/>
      <geom name="cube" type="box" size="0.0524 0.0524 0.0524"/>
    </body>
  </worldbody>
</mujoco>
"""


def identified(tosses: Path, cone: str, folder: Path, more: list[str]) -> dict[str, object]:
    """Run the command and return ``identification.json``."""
    model = folder / f"{cone}.xml"
    model.write_text(MODEL.format(cone=cone))
    out = folder / cone
    subprocess.run(
        [sys.executable, "-m", "pytest_twin.cli", "identify", str(model), str(tosses),
         "--out", str(out), *more],
        stdout=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    found: dict[str, object] = json.loads((out / "identification.json").read_text())
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tosses", type=Path, default=RECORDINGS / "cube_tosses/tosses.npz")
    parser.add_argument("--cone", choices=("pyramidal", "elliptic"), action="append")
    args, more = parser.parse_known_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for cone in args.cone or ("pyramidal", "elliptic"):
            document = identified(args.tosses, cone, Path(folder), more)
            rows += table_rows(document, cone)
    print("| model | tosses | position [% of width] | rotation [deg] |\n|---|---|---|---|")
    print("\n".join(rows))


def table_rows(document: dict, cone: str) -> list[str]:
    held = document["held_out"]["cube"]
    width = held["toss_position"] / held["toss_position_widths"]
    nominal = held["toss_position_nominal"] / width
    rows = [
        row(f"MuJoCo's defaults, {cone} cone", held["tosses"], nominal,
            held["toss_rotation_nominal"]),
        row(f"identified, {cone} cone", held["tosses"], held["toss_position_widths"],
            held["toss_rotation"]),
    ]  # fmt: skip
    for name, one in document["parameters"].items():
        low, high = one["ci95"]
        rows.append(f"| {name} | | {one['value']:.4g} {one['unit']} | {low:.4g} to {high:.4g} |")
    for one in document["contact"]["spread"]:
        found = one["held_out"]
        rows.append(row(f"{cone}, {one['simulation']}", found["tosses"],
                        found["toss_position_widths"], found["toss_rotation"]))  # fmt: skip
        values = ", ".join(f"{n} {v:.4g}" for n, v in one["parameters"].items())
        rows.append(f"| its estimates | | {values} | |")
    return rows


def row(name: str, tosses: int, position: float, rotation: float) -> str:
    return f"| {name} | {tosses} | {100 * position:.1f} | {math.degrees(rotation):.1f} |"


if __name__ == "__main__":
    main()
