"""TX40: compare base parameters and held-out effort errors with the published ones.

    python benchmarks/identification/tx40.py [--out DIR]

Published values: Staubli TX40, weighted least squares of the essential parameters, with their
relative deviations in percent (thanhndv212/figaroh-plus). The authors fitted the whole run. Here
the first four fifths are fitted and the last fifth is held out. The robot is at rest in five sixths
of the held-out part, where dry friction hides errors up to its level.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tx40_files

from pytest_twin.identification.effort.filtering import choose_filter
from pytest_twin.identification.effort.groups import dry_of
from pytest_twin.identification.effort.identify_effort import identify_effort
from pytest_twin.identification.effort.least_squares import LinearProblem, linear_problem
from pytest_twin.identification.effort.recording_rows import sample
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.identification.regressor import Regressor, SharedMotor, structural_base
from pytest_twin.realization import load
from pytest_twin.twin import load_twin

WELL_KNOWN = 5.0
"""Largest relative deviation, percent, of published values that are compared with ours."""
Z95 = 1.959964


def published(source: Path) -> list[tuple[str, float, float]]:
    """Published parameters: expression, weighted least-squares value, standard deviation."""
    with (source / "published_parameters.csv").open() as file:
        rows = [row for row in csv.reader(file) if row]
    return [
        (
            row[0].replace("1.0*", "").strip(),
            float(row[3]),
            abs(float(row[3])) * float(row[4]) / 100,
        )
        for row in rows
    ]


def relative(problem: LinearProblem, values: np.ndarray, moving: bool) -> list[float]:
    """|measured - predicted| / |measured| of each joint, in percent."""
    off = problem.effort - problem.matrix @ values
    use = ~problem.resting if moving else np.ones_like(problem.resting)
    return [
        100
        * float(np.linalg.norm(off[use[:, k], k]) / np.linalg.norm(problem.effort[use[:, k], k]))
        for k in range(off.shape[1])
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="keep the files and the identification here")
    args = parser.parse_args()
    source = tx40_files.folder()
    if source is None:
        raise SystemExit("no recordings of the TX40: the variable TWIN_RECORDINGS says where")
    with tempfile.TemporaryDirectory() as scratch:
        out = args.out or Path(scratch)
        out.mkdir(parents=True, exist_ok=True)
        paths = tx40_files.write(source, out)
        since = time.perf_counter()
        command = [
            str(Path(sys.executable).with_name("pytest-twin")), "identify", str(paths["twin"]),
            str(paths["fit"]), "--held-out", str(paths["held_out"]),
            "--out", str(out / "identified"),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 2:
            raise SystemExit(done.stderr)
        spent = time.perf_counter() - since
        document = json.loads((out / "identified/identification.json").read_text())
        print(f"pytest-twin identify: {document['verdict']}, {spent:.1f} s\n")
        compare_parameters(document, published(source))
        compare_errors(document, published(source), paths)


def compare_parameters(document: dict, known: list[tuple[str, float, float]]) -> None:
    ours = {one["expression"]: one for one in document["base_parameters"]}
    print(f"{'base parameter':34} {'here':>10} {'dev.':>7} {'published':>10} {'dev.':>7}  apart")
    inside = total = 0
    for expression, value, std in known:
        one = ours[expression]
        deviation = 100 * std / abs(value)
        if not one["essential"]:
            print(f"{expression[:34]:34} {'-':>10} {'':7} {value:10.4f} {deviation:6.2f} %")
            total += deviation < WELL_KNOWN
            continue
        apart = abs(one["value"] - value) / np.hypot(one["std"], std)
        if deviation < WELL_KNOWN:
            total += 1
            inside += apart <= Z95
        print(
            f"{expression[:34]:34} {one['value']:10.4f} {100 * one['relative_std']:6.2f} % "
            f"{value:10.4f} {deviation:6.2f} %  {apart:.2f} standard deviations"
        )
    more = [e for e, one in ours.items() if one["essential"] and e not in {k for k, _, _ in known}]
    print(f"\nessential here and not there: {', '.join(more) or 'none'}")
    print(
        f"published values of a relative deviation under {WELL_KNOWN:g} % within the joint 95 % "
        f"interval: {inside} of {total} (goal: all)\n"
    )


def compare_errors(document: dict, known: list[tuple[str, float, float]], paths: dict) -> None:
    twin = load_twin(paths["twin"])
    robot = load(
        next(iter(twin.realizations.values())).file,
        twin=twin, shapes=False, accept_invalid_inertia=True,
    )  # fmt: skip
    read = {
        name: read_measured(
            paths[name], robot, twin.topics, twin.recordings, twin.recordings.signals
        )
        for name in ("fit", "held_out", "whole")
    }
    regressor = Regressor(robot, tx40_files.JOINTS, [SharedMotor("joint_6", "joint_5")])
    base = structural_base(regressor)
    chosen = choose_filter(read["fit"])
    dry = dry_of(regressor.columns, regressor.joints)[:, base.independent]
    tested = linear_problem(sample(read["held_out"], [regressor], chosen), base.independent, dry)
    at = {expression: k for k, expression in enumerate(base.expressions)}
    theirs, ours = np.zeros(len(base)), np.zeros(len(base))
    for expression, value, _ in known:
        theirs[at[expression]] = value
    for one in document["base_parameters"]:
        ours[at[one["expression"]]] = one["value"]
    whole = identify_effort(
        robot, MeasuredRecordings(tuple(read["whole"]), ()), twin.recordings.signals
    ).fitted.values
    print("held-out effort error in percent (last fifth of the run; same motion, same filter)")
    print(f"{'parameters':34} " + " ".join(f"{joint:>8}" for joint in tx40_files.JOINTS))
    for moving in (False, True):
        suffix = ", while it moves" if moving else ""
        for name, values in (
            ("here, first four fifths", ours), ("here, whole run", whole),
            ("published, whole run", theirs),
        ):  # fmt: skip
            shown = " ".join(f"{error:8.1f}" for error in relative(tested, values, moving))
            print(f"{name + suffix:34} {shown}")


if __name__ == "__main__":
    main()
