"""``pytest-twin init``: a working twin around a robot's file."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

from pytest_twin.commands import folders
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats import atomic
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.runner import Runner
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.setup import writing
from pytest_twin.twin import FILE_NAME, MODEL_SUFFIXES

HELP = "write a working twin around a URDF or MJCF file: twin.yaml and first golden specs, recorded"
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("robot", metavar="ROBOT", type=Path, help="URDF (.urdf) or MJCF (.xml)")
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path(),
        help="the twin's folder (default: the working directory); a robot from elsewhere is "
        "copied to DIR/asset",
    )


def run(args: argparse.Namespace) -> int:
    """0 once the twin stands and its first goldens are recorded.

    Raises:
        TwinError: no model that could be loaded, or a twin that is there already.
    """
    robot: Path = args.robot.resolve()
    folder: Path = args.out.resolve()
    if not robot.is_file() or robot.suffix.lower() not in MODEL_SUFFIXES:
        raise SpecError(
            "no robot file", path=args.robot, expected="a URDF (.urdf) or an MJCF (.xml) file"
        )
    if (folder / FILE_NAME).exists():
        raise SpecError("there is a twin already", path=folder / FILE_NAME, expected="a new folder")
    with writing.all_or_nothing(folder):
        return _set_up(robot, folder)


def _set_up(robot: Path, folder: Path) -> int:
    with Sandbox(cwd=None) as sandbox:
        seen = sandbox.call("pytest_twin.setup.inspection:look", {"model": str(robot)})
        folders.make(folder)
        files = [Path(path) for path in seen["files"]]
        model, source = writing.bring_in(robot, files, folder)
        twin_file = writing.write_twin_file(
            folder,
            name=re.sub(r"[^A-Za-z0-9_.-]", "_", robot.stem),
            model=model,
            source=source,
            tcp=seen["tcp"],
            inertia_repairs=seen["inertia_repairs"],
        )
        writing.write_schemas(folder)
        writing.ignore_scratch(folder)
        found = sandbox.call(
            "pytest_twin.setup.inspection:first_specs",
            {"twin": str(twin_file)},
            progress=lambda fraction: _say_progress("looking", fraction),
        )
    for note in seen["notes"]:
        print(f"note: {note}")
    specs = [writing.write_spec(folder, spec) for spec in found["specs"]]
    recorded, failing, left_out = _record(twin_file, specs)
    summary = {
        "twin": str(twin_file),
        "goldens": recorded,
        "failing": failing,
        "left_out": left_out | found["silent"],
        "nothing_to_propose": found["none"],
        "notes": seen["notes"],
    }
    atomic.write_text(folder / ".twin" / "init.json", json.dumps(summary, indent=2) + "\n")
    kinds = sorted({Path(golden).parts[1] for golden in recorded})
    print(f"{twin_file}: {len(recorded)} goldens of {len(kinds)} kinds: {', '.join(kinds)}")
    if found["none"]:
        print(f"nothing to propose for: {', '.join(found['none'])}")
    for where, why in summary["left_out"].items():
        print(f"left out: {where}: {why}")
    for where, why in failing.items():
        print(f"FAILS as it stands: {where}: {why}")
    print("next: pytest --twin-release")
    return DONE


def _record(twin_file: Path, specs: list[Path]) -> tuple[list[str], dict[str, str], dict[str, str]]:
    """Record every first golden; one that cannot run on this robot is taken out again."""
    recorded: list[str] = []
    failing: dict[str, str] = {}
    left_out: dict[str, str] = {}
    with Runner() as runner:
        gate = Gate(twin_file, runner)
        for done, path in enumerate(specs):
            _say_progress("recording", done / max(len(specs), 1))
            try:
                golden = gate.golden(path)
                outcome, _ = gate.record(golden, None)
            except TwinError as error:
                left_out[path.relative_to(twin_file.parent).as_posix()] = str(error)
                path.unlink()
                continue
            if outcome.status == "error":
                left_out[golden.id] = outcome.error or "it did not run"
                path.unlink()
                continue
            recorded.append(golden.id)
            if outcome.status == "failed":
                worst = min(outcome.measures, key=lambda measure: measure.margin)
                failing[golden.id] = (
                    f"{worst.name} of {worst.subject}: {worst.error:.3g} {worst.unit}, "
                    f"tolerance {worst.tolerance:.3g} {worst.unit}"
                )
    _say_progress("recording", 1.0)
    return recorded, failing, left_out


def _say_progress(what: str, fraction: float) -> None:
    if sys.stderr.isatty():
        end = "\n" if fraction >= 1.0 else ""
        print(f"\r{what} {100 * fraction:3.0f} %", end=end, file=sys.stderr, flush=True)
