"""Convert the recording of TIAGo's torso and arm to input files, cut in two."""

from __future__ import annotations

import gzip
import os
import shutil
from pathlib import Path

import numpy as np

HELD_OUT = 0.25


def folder() -> Path | None:
    """Return the folder of the recordings; None if it does not exist."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "recordings"
    found = Path(os.environ.get("TWIN_RECORDINGS") or beside) / "tiago"
    return found if found.is_dir() else None


def write(source: Path, out: Path) -> dict[str, Path]:
    """Write ``twin.yaml``, the model, ``fit.csv`` and ``held_out.csv`` (the last quarter).

    The torso's effort is a force; the arm's are motor currents of unknown torque constant.
    """
    tables = {}
    for quantity in ("position", "velocity", "effort"):
        with gzip.open(source / f"{quantity}.csv.gz", "rt") as file:
            head = file.readline().strip().split(",")
            tables[quantity] = np.loadtxt(file, delimiter=",")
    joints = [name.removeprefix("- ").removesuffix("_effort") for name in head[1:]]
    columns = [f"{joint}.{quantity}" for quantity in tables for joint in joints]
    table = np.column_stack([tables["position"][:, 0], *(t[:, 1:] for t in tables.values())])
    cut = round((1.0 - HELD_OUT) * len(table))
    paths = {"twin": out / "twin.yaml"}
    for name, rows in {"fit": slice(0, cut), "held_out": slice(cut, None)}.items():
        paths[name] = out / f"{name}.csv"
        np.savetxt(
            paths[name], table[rows], fmt="%.9g", delimiter=",",
            header=",".join(["time", *columns]), comments="",
        )  # fmt: skip
    shutil.copyfile(source / "tiago.urdf", out / "tiago.urdf")
    lines = [
        "model: tiago.urdf",
        "signals:",
        "  default: {effort: {quantity: current}}",
    ]
    paths["twin"].write_text("\n".join(lines) + "\n")
    return paths
