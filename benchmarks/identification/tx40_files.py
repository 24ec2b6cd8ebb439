"""Convert the TX40's recordings to input files, with a twin.yaml that describes the signals."""

from __future__ import annotations

import gzip
import math
import os
import shutil
from pathlib import Path

import numpy as np

RATE = 5000.0
JOINTS = tuple(f"joint_{number}" for number in range(1, 7))
GEARS = (32, 32, 45, -48, 45, 32)
ZEROS = {"joint_2": -math.pi / 2, "joint_3": math.pi / 2}
HELD_OUT = 0.2


def folder() -> Path | None:
    """Return the folder of the recordings; None if it does not exist."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "recordings"
    found = Path(os.environ.get("TWIN_RECORDINGS") or beside) / "tx40"
    return found if found.is_dir() else None


def write(source: Path, out: Path) -> dict[str, Path]:
    """Write ``twin.yaml``, the model, and the run as fit, held_out (last fifth) and whole.

    The files contain the recorded motor positions and motor torques without scaling.
    """
    positions = read_table(source / "motor_positions.csv.gz")
    torques = read_table(source / "currents.csv.gz")
    time = np.arange(len(positions)) / RATE
    head = ",".join(["time", *(f"{j}.position" for j in JOINTS), *(f"{j}.effort" for j in JOINTS)])
    cut = round((1.0 - HELD_OUT) * len(positions))
    paths = {"twin": out / "twin.yaml"}
    for name, rows in {
        "fit": slice(0, cut), "held_out": slice(cut, None), "whole": slice(None),
    }.items():  # fmt: skip
        paths[name] = out / f"{name}.csv"
        table = np.column_stack([time, positions, torques])[rows]
        np.savetxt(paths[name], table, fmt="%.9g", delimiter=",", header=head, comments="")
    shutil.copyfile(source / "tx40.urdf", out / "tx40.urdf")
    paths["twin"].write_text(_twin())
    return paths


def _twin() -> str:
    lines = [
        "model: tx40.urdf",
        "signals:",
        "  default: {position: {side: motor}, effort: {side: motor}}",
        "  joints:",
    ]
    for joint, gear in zip(JOINTS, GEARS, strict=True):
        own = f"gear: {gear}, zero: {ZEROS.get(joint, 0.0)!r}"
        if joint == "joint_6":
            own += ", shared_with: {joint: joint_5}"
        lines.append(f"    {joint}: {{{own}}}")
    return "\n".join(lines) + "\n"


def read_table(path: Path) -> np.ndarray:
    with gzip.open(path, "rt") as file:
        return np.loadtxt(file, delimiter=",", skiprows=1)
