"""Run audit and realize on every URDF of example-robot-data, and tabulate the results.

    python benchmarks/assets.py [--only WORD] [--table docs/assets-table.md]

Each robot is read in a child process with limits on time and memory, so a crash or a hang affects
one row only. For comparison, MuJoCo and Pinocchio load the same file in the same kind of process.
Times depend on the machine; only their ratio is meaningful.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import distribution, version
from pathlib import Path
from typing import Any

import shipped

from pytest_twin.errors import LimitError, SimulationError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.realization.sandbox import Sandbox

SECONDS = 300.0
PAIRS = tuple((w, b) for w in ("audit", "realize") for b in ("MuJoCo", "Pinocchio"))
POSITION, ORIENTATION = "forward kinematics, position", "forward kinematics, orientation"


# -- code of the child process


def warm() -> None:
    """Import all modules, so that import time is not measured."""
    import pinocchio  # noqa: F401

    import pytest_twin.asset.realize
    import pytest_twin.audit.audit_file

    del pytest_twin


def load_in_mujoco(path: str) -> float:
    """Return the time of MuJoCo's own loader, s."""
    import mujoco

    start = time.perf_counter()
    mujoco.MjModel.from_xml_path(path)
    return time.perf_counter() - start


def load_in_pinocchio(path: str, packages: str) -> float:
    """Return the time of Pinocchio's own loader with collision shapes, s."""
    import pinocchio as pin

    start = time.perf_counter()
    model = pin.buildModelFromUrdf(path)
    pin.buildGeomFromUrdf(model, path, pin.GeometryType.COLLISION, None, [packages])
    return time.perf_counter() - start


# -- one robot


@dataclass(slots=True)
class Entry:
    """A robot with its results.

    Attributes:
        error: reason why the robot cannot be read.
        repairs: named patches that were accepted for the realization.
        failures: critical lines of the realization after the repairs.
        worst: target -> largest (position in m, orientation in rad) error against Pinocchio.
        counts: conversion -> verdict -> number of rows.
        times: program -> time, s; None if it refused the file.
        audit: severity -> number of findings, and the exit status.
        hung, crashed: whether the process hung or crashed, which must not happen.
    """

    name: str
    error: str | None = None
    repairs: list[str] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    worst: dict[str, tuple[float, float]] = field(default_factory=dict)
    counts: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    times: dict[str, float | None] = field(default_factory=dict)
    audit: dict[str, int] = field(default_factory=dict)
    accidents: list[str] = field(default_factory=list)


def run_all(only: str | None) -> list[Entry]:
    robots, packages = _robots()
    wanted = [path for path in robots if only is None or only in str(path)]
    entries = []
    # The child imports this file, and nothing from below the working folder.
    with (
        tempfile.TemporaryDirectory() as empty,
        contextlib.chdir(empty),
        Sandbox(seconds=SECONDS) as child,
    ):
        child.call("assets:warm")
        for count, path in enumerate(wanted):
            entry = _run(child, path, path.relative_to(packages / "example-robot-data/robots"))
            entry.times["MuJoCo"] = _timed(child, entry, "load_in_mujoco", {"path": str(path)})
            arguments = {"path": str(path), "packages": str(packages)}
            entry.times["Pinocchio"] = _timed(child, entry, "load_in_pinocchio", arguments)
            entries.append(entry)
            print(f"{count + 1}/{len(wanted)} {_line(entry)}", file=sys.stderr, flush=True)
    return entries


def _robots() -> tuple[list[Path], Path]:
    """Return every URDF of the package, and the folder for resolving package:// names."""
    files = distribution("example-robot-data").files or []
    found = sorted(Path(str(file.locate())).resolve() for file in files if file.suffix == ".urdf")
    share = next(parent for parent in found[0].parents if parent.name == "example-robot-data")
    return found, share.parent


def _run(child: Sandbox, path: Path, name: Path) -> Entry:
    entry = Entry(name.as_posix())
    folder = Path(tempfile.mkdtemp(prefix="assets-"))
    try:
        start = time.perf_counter()
        found = child.call("pytest_twin.audit.audit_file:audit_file", {"path": str(path)})
        entry.times["audit"] = time.perf_counter() - start
        for finding in found["findings"]:
            severity = finding["severity"]
            entry.audit[severity] = entry.audit.get(severity, 0) + 1
    except TwinError as error:
        _accident(entry, "audit", error)
        entry.times["audit"] = None
    try:
        made, seconds = _realize(child, path, folder / "first", [])
        if made["patches"]:
            entry.repairs = made["patches"]
            made, seconds = _realize(child, path, folder / "second", entry.repairs)
        entry.times["realize"] = seconds
        entry.failures = made["critical"] + made["left_out"]
        entry.counts = made["counts"]
        matrix = json.loads((Path(made["folder"]) / "loss.json").read_text())
        for conversion in matrix["conversions"]:
            rows = {row["feature"]: row["difference"] for row in conversion["rows"]}
            if rows:
                entry.worst[conversion["target"]] = (rows[POSITION], rows[ORIENTATION])
    except TwinError as error:
        _accident(entry, "realize", error)
        entry.error = error.problem
        entry.times["realize"] = None
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return entry


def _realize(
    child: Sandbox, path: Path, folder: Path, accept: list[str]
) -> tuple[dict[str, Any], float]:
    folder.mkdir()
    start = time.perf_counter()
    made = child.call(
        "pytest_twin.asset.realize:realize",
        {"source": str(path), "folder": str(folder), "accept": accept},
    )
    seconds = time.perf_counter() - start
    return {**made, "folder": str(folder)}, seconds


def _timed(child: Sandbox, entry: Entry, function: str, arguments: dict[str, str]) -> float | None:
    try:
        return float(child.call(f"assets:{function}", arguments))
    except TwinError:
        # The other loaders may refuse a file or crash.
        return None


def _accident(entry: Entry, what: str, error: TwinError) -> None:
    if isinstance(error, SimulationError | LimitError):
        entry.accidents.append(f"{what}: {error}")


# -- the table


def _line(entry: Entry) -> str:
    seconds = entry.times.get("realize")
    told = entry.error or ("; ".join(entry.failures) or "clean")
    return f"{entry.name}: {told[:100]}" + ("" if seconds is None else f" ({seconds:.1f} s)")


def table(entries: list[Entry]) -> str:
    """Return the page of the documentation."""
    usable = [entry for entry in entries if entry.error is None]
    lines = [
        "# Every URDF of example-robot-data",
        "",
        "Written by `python benchmarks/assets.py --table docs/assets-table.md`: example-robot-data "
        f"{version('example-robot-data')}, MuJoCo {version('mujoco')}, Pinocchio {version('pin')}, "
        f"urdf-usd-converter {version('urdf-usd-converter')}.",
        "",
        *_summary(entries, usable),
        "",
        "Forward kinematics is the worst of all frames at six configurations, against Pinocchio. "
        "*Repairs* are named patches, accepted with `--accept`: without them the robot fails. "
        "Rows of the loss matrix are counted kept / changed / lost. Times are of one run on a "
        "shared machine; MuJoCo's and Pinocchio's are their own load of the same file.",
        "",
        "| robot | repairs | MJCF: m, rad | USD: m, rad | MJCF | USD | Pinocchio "
        "| audit: critical, warning | audit s | realize s | MuJoCo s | Pinocchio s |",
        "|" + " --- |" * 12,
    ]
    for entry in entries:
        cells = [entry.name]
        if entry.error is not None:
            cells += [f"unusable: {entry.error}"] + [""] * 5
        else:
            cells.append(str(len(entry.repairs) or ""))
            cells += [_pair(entry.worst.get(target)) for target in ("MJCF", "USD")]
            for target in ("MJCF", "USD", "Pinocchio"):
                counts = entry.counts.get(f"URDF -> {target}")
                cells.append(" / ".join(map(str, counts.values())) if counts else "-")
        cells.append(f"{entry.audit.get('critical', 0)}, {entry.audit.get('warning', 0)}")
        for what in ("audit", "realize", "MuJoCo", "Pinocchio"):
            seconds = entry.times.get(what)
            cells.append("refuses" if seconds is None else f"{seconds:.2g}")
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _summary(entries: list[Entry], usable: list[Entry]) -> list[str]:
    def within(target: str) -> str:
        worst = [entry.worst[target] for entry in usable if target in entry.worst]
        exact = sum(max(pair) <= 1e-9 for pair in worst)
        position = max((pair[0] for pair in worst), default=0.0)
        turn = max((pair[1] for pair in worst), default=0.0)
        return (
            f"- {target}: {len(worst)} of {len(usable)} compile; forward kinematics within 1e-9 m "
            f"and rad for {exact}, at worst {position:.1e} m and {turn:.1e} rad."
        )

    repaired = [entry for entry in usable if entry.repairs]
    accidents = [line for entry in entries for line in entry.accidents]
    refused = {
        what: sum(entry.times.get(what) is None for entry in entries)
        for what in ("MuJoCo", "Pinocchio")
    }
    return [
        f"- {len(entries)} files, {len(usable)} robots; the others are named with their reason.",
        f"- {len(usable) - len(repaired)} realize as they are, {len(repaired)} after named repairs "
        "of inertias that no body can have.",
        within("MJCF"),
        within("USD"),
        f"- Crashes and hangs: {len(accidents)}.",
        f"- MuJoCo's own loader refuses {refused['MuJoCo']} of the files, Pinocchio's "
        f"{refused['Pinocchio']}.",
        *(_ratio(entries, what, beside) for what, beside in PAIRS),
    ]


def _ratio(entries: list[Entry], what: str, beside: str) -> str:
    """Return the sums over the robots that both can read."""
    both = [
        (ours, theirs)
        for entry in entries
        if (ours := entry.times.get(what)) is not None
        and (theirs := entry.times.get(beside)) is not None
    ]
    ours, theirs = (sum(times) for times in zip(*both, strict=True)) if both else (0.0, 1.0)
    return (
        f"- {what} of {len(both)} robots: {ours:.3g} s, {ours / theirs:.3g} times {beside}'s own "
        f"load of them ({theirs:.2g} s)."
    )


def _pair(worst: tuple[float, float] | None) -> str:
    return "-" if worst is None else f"{worst[0]:.0e}, {worst[1]:.0e}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="robots whose path holds this word")
    parser.add_argument("--table", type=Path, help="write the page there")
    args = parser.parse_args()
    entries = run_all(args.only)
    page = table(entries)
    if args.table is None:
        print(page)
    else:
        # The section that benchmarks/shipped.py writes stays at the end of the page.
        before = args.table.read_text() if args.table.is_file() else ""
        _, heading, rest = before.partition(shipped.HEADING)
        text = heading + rest
        atomic.write_text(args.table, shipped.with_section(page, text) if text else page)
    accidents = [line for entry in entries for line in entry.accidents]
    for line in accidents:
        print(line, file=sys.stderr)
    return 1 if accidents else 0


if __name__ == "__main__":
    raise SystemExit(main())
