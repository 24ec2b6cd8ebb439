"""Calibrate a hundred random cells with known truth by the command line, and print a table.

    MUJOCO_GL=egl python benchmarks/calibration/blind_cells.py [--cells 100] [--first 0]

Each cell is a folder with a plan and its observations, which ``pytest-twin calibrate`` reads. The
truth comes from MuJoCo (``simulated.py``) and is read only after the result was written.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))

import drawn_cells as cells

from pytest_twin import cli


@dataclass
class Score:
    """Comparison of one cell's result with the truth.

    Attributes:
        kind: kind of the cell.
        status: exit status of the command.
        verdict: verdict of the result.
        inside: for each interval, whether it contains the truth.
        held_out: held-out RMS translation error divided by the noise of a position.
        missed: number of outliers that were neither excluded nor held out.
    """

    kind: str
    status: int
    verdict: str
    inside: list[bool]
    held_out: float
    missed: int


def solve(cell: cells.Cell) -> tuple[int, dict[str, Any]]:
    """Run the command; return exit status and ``calibration.json``."""
    out = cell.plan.parent / "out"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as e:
        status = cli.main(["calibrate", str(cell.plan), "--out", str(out)])
    if status == 2:
        return status, {"verdict": e.getvalue().strip(), "records": {}, "held_out": {}}
    return status, json.loads((out / "calibration.json").read_text())


def score(cell: cells.Cell, status: int, found: dict[str, Any]) -> Score:
    """Compare the result with the truth."""
    inside: list[bool] = []
    records = found["records"]
    for name, truth in cell.transforms.items():
        if name in records:
            inside += holds(records[name], truth)
    for name, truth in cell.scalars.items():
        record, _, part = name.partition(".")
        if record not in records:
            continue
        one = records[record]["values"].get(part) if part else records[record]
        if one is not None:
            inside.append(one["ci95"][0] <= truth <= one["ci95"][1])
    error = found["held_out"].get("translation_rms", float("nan"))
    left_out = {one["id"] for one in found.get("excluded", ())}
    return Score(
        cell.kind, status, found["verdict"], inside, error / cell.noise,
        len(cell.outliers - left_out),
    )  # fmt: skip


def holds(record: dict[str, Any], truth: np.ndarray) -> list[bool]:
    """Whether each of a transform's six intervals contains the true (4, 4) transform."""
    w, *xyz = record["transform"]["quaternion_wxyz"]
    turn = Rotation.from_quat([*xyz, w]).inv() * Rotation.from_matrix(truth[:3, :3])
    values = [*truth[:3, 3], *turn.as_rotvec()]
    spans = [record["ci95"][name] for name in ("x", "y", "z", "rx", "ry", "rz")]
    return [low <= value <= high for (low, high), value in zip(spans, values, strict=True)]


def table(scores: list[Score]) -> str:
    """Return a Markdown table with a row for each kind."""
    lines = [
        "| cells | number | accepted | refused | intervals | hold the truth | held-out / noise |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in (*cells.KINDS, "all"):
        mine = [one for one in scores if kind in (one.kind, "all")]
        if not mine:
            continue
        inside = [value for one in mine for value in one.inside if one.status == 0]
        errors = [one.held_out for one in mine if one.status == 0 and np.isfinite(one.held_out)]
        share = f"{100 * np.mean(inside):.1f} %" if inside else ""
        error = f"{np.median(errors):.2f} (at most {max(errors):.2f})" if errors else ""
        accepted = sum(one.status == 0 for one in mine)
        lines.append(
            f"| {kind} | {len(mine)} | {accepted} | {sum(one.status == 1 for one in mine)} | "
            f"{len(inside) or ''} | {share} | {error} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kind", choices=list(cells.KINDS))
    parser.add_argument("--keep", type=Path, help="folder for the cells; a temporary one without")
    arguments = parser.parse_args()
    scores = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        for seed in range(arguments.first, arguments.first + arguments.cells):
            if arguments.kind and cells.kind_of(seed) != arguments.kind:
                continue
            cell = cells.make(seed, folder / f"{seed:04d}")
            one = score(cell, *solve(cell))
            scores.append(one)
            wrong = sum(not value for value in one.inside)
            print(
                f"{seed} {one.kind}, {cell.mount}: {one.verdict}, {wrong} of {len(one.inside)} "
                f"intervals miss the truth, held-out error {one.held_out:.2f} of the noise, "
                f"{one.missed} of {len(cell.outliers)} outliers stayed",
                flush=True,
            )
    print("\n" + table(scores))


if __name__ == "__main__":
    main()
