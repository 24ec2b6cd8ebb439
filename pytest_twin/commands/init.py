"""``pytest-twin init``: set up a twin for a robot's file."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pytest_twin.asset import manifest
from pytest_twin.asset.manifest import Manifest
from pytest_twin.commands import json_output, model_files, xacro_files
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.recording_arguments import (
    RECORDING_HELP,
    add_recording_arguments,
    recording_options,
)
from pytest_twin.commands.terminal import show
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.formats import atomic, typed
from pytest_twin.formats.declared_inputs import declared_inputs, declaring
from pytest_twin.formats.expansions import SUFFIX, model_stem
from pytest_twin.gate.coverage import AUDIT
from pytest_twin.gate.gate import Gate
from pytest_twin.gate.runner import Runner
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.report.failure import what
from pytest_twin.servos.library import find
from pytest_twin.servos.prior import TwinServo
from pytest_twin.setup import writing
from pytest_twin.setup.anew import propose_anew
from pytest_twin.setup.asset_files import ASSET, CopiedFiles, RobotFiles, copy_into_twin
from pytest_twin.setup.recordings import ROOT, TaskTolerance, parse_tolerance, place_recordings
from pytest_twin.twin import FILE_NAME, MODEL_SUFFIXES
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin init arm.urdf",
    "pytest-twin init arm_twin/twin.yaml",
    "pytest-twin init vendor/arm.xml --out arm_twin",
    "pytest-twin init arm.urdf --servo sts3215",
    "pytest-twin init arm.urdf moves.mcap --tolerance 5mrad,wrist=2mrad",
)
EXIT_STATUS = {0: "the twin is set up and its goldens are recorded"}
DONE = 0
_NAMES_AND_LINES = re.compile(r"'[^']*'|:\d+:")
_FOR_THE_READER = ("Tolerance", "To write", "Not tested by this step")
"""Prefix of notes that are relevant only to readers of a golden."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "robot",
        metavar="ROBOT",
        type=Path,
        help="URDF (.urdf), MJCF (.xml) or xacro file; or twin.yaml, to propose goldens anew: "
        "those that can still be compared stay as they are",
    )
    parser.add_argument(
        "recordings",
        metavar="RECORDING",
        type=Path,
        nargs="*",
        help=f"recording of the robot; a replay golden is written for each: {RECORDING_HELP}",
    )
    parser.add_argument(
        "--tolerance",
        metavar="5mrad,0.2mm,JOINT=2mrad",
        type=_tolerance,
        default=TaskTolerance(),
        help="largest difference between replay and recording that the task allows: for all "
        "revolute joints in rad, mrad or deg, for all prismatic joints in m, mm or um, or for one "
        "joint (default: a blank in each replay golden, which fails until you fill it in)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path(),
        help="folder of the twin (default: the working directory); a robot outside it is copied to "
        "DIR/asset",
    )
    parser.add_argument(
        "--servo",
        metavar="NAME",
        help="servo of all drives, from the library of identified servos (pytest-twin servo list): "
        "its gains, limits and friction are written under fit:, and their intervals under servos:",
    )
    model_files.add_arguments(parser)
    xacro_files.add_arguments(parser)
    add_recording_arguments(parser)


def _tolerance(text: str) -> TaskTolerance:
    try:
        return parse_tolerance(text)
    except SpecError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def run(args: argparse.Namespace) -> int:
    """Set up the twin and record its first goldens; return 0.

    Raises:
        TwinError: the model cannot be loaded, or a twin exists already.
    """
    robot: Path = args.robot.resolve()
    if robot.name == FILE_NAME:
        return _propose_anew(robot, args)
    folder: Path = args.out.resolve()
    if not robot.is_file() or robot.suffix.lower() not in (*MODEL_SUFFIXES, SUFFIX):
        raise SpecError(
            "no robot file",
            path=args.robot,
            expected="a URDF (.urdf), an MJCF (.xml) or a xacro file (.xacro)",
        )
    aside = writing.set_aside(folder)
    if aside is not None and aside.is_dir():
        show(f"note: an earlier init was stopped; what it had written is now in {aside}")
    if (folder / FILE_NAME).exists():
        raise SpecError("a twin exists already", path=folder / FILE_NAME, expected="a new folder")
    if robot.suffix != SUFFIX and args.xacro:
        raise SpecError(
            "not a xacro file", path=robot, where="--xacro", expected="a file NAME.xacro"
        )
    # Refused before anything is written, which would change the source.
    asset = _asset_of(robot, folder)
    with writing.all_or_nothing(folder):
        inputs = declared_inputs()
        if robot.suffix == SUFFIX:
            robot = _realized(robot, folder, args)
            asset = _asset_of(robot, folder)
            # The packages are in the asset now.
            inputs = replace(inputs, packages={})
        with declaring(inputs):
            return _set_up(robot, asset, folder, args)


def _realized(robot: Path, folder: Path, args: argparse.Namespace) -> Path:
    """Take in the packages of a xacro file and realize it in the twin's folder; return its URDF.

    Intake and realize write the manifest by which the gate sees that an included file changed.
    """
    # A second of imports that only xacro files need.
    from pytest_twin.commands import intake, realize

    asset = folder / ASSET / model_stem(robot)
    atomic.make_folder(asset.parent)
    common = {"root": args.root, "package": args.package, "xacro": args.xacro, "json": None}
    intake.run(argparse.Namespace(origin=robot, out=asset, supplier=None, date=None, **common))
    source = xacro_files.place_in_delivery(robot, asset / manifest.SOURCE_FOLDER)
    with declaring(replace(declared_inputs(), packages={})):
        realize.run(argparse.Namespace(urdf=source, out=asset, accept=[], **common))
    return asset / f"{model_stem(robot)}.urdf"


def _asset_of(robot: Path, folder: Path) -> tuple[Path, Manifest] | None:
    """The manifest of the asset that a model is a state of, None without one.

    Raises:
        PathError: its source has changed since intake.
        FormatError: its manifest was changed.
        SpecError: the twin would be inside the source.
    """
    asset = manifest.find(robot)
    if asset is None:
        return None
    manifest.require_unchanged_source(*asset)
    if asset[1].keeps_source and folder.is_relative_to(asset[0].parent / manifest.SOURCE_FOLDER):
        raise SpecError(
            "the twin would be inside the source of an asset, which never changes",
            path=folder,
            expected="another folder for --out",
        )
    return asset


def _supplied_files(asset: tuple[Path, Manifest] | None, brought: CopiedFiles) -> Iterable[Path]:
    """The supplier's files for ``source:``: for a generated model those that it was made from."""
    if asset is None or brought.manifest is None:
        return brought.files
    at, known = brought.manifest.parent, asset[1]
    if not brought.model.is_relative_to(at) or (
        known.state_of(brought.model.relative_to(at).as_posix()) == "source"
    ):
        return brought.files
    if not known.keeps_source:
        return ()
    return [at / name for name in known.states["normalized"].made_from]


def _set_up(
    robot: Path, asset: tuple[Path, Manifest] | None, folder: Path, args: argparse.Namespace
) -> int:
    with Sandbox(cwd=None) as sandbox, Progress("reading the robot") as progress:
        seen = sandbox.call("pytest_twin.setup.inspection:inspect_model", {"model": str(robot)})
        atomic.make_folder(folder)
        brought = copy_into_twin(
            RobotFiles(
                robot,
                [Path(path) for path in seen["files"]],
                Path(seen["root"]),
                {name: Path(package) for name, package in seen["packages"].items()},
                [root.resolve() for root in args.root],
                () if asset is None else manifest.all_files(*asset),
            ),
            folder,
        )
        references, root = place_recordings(args.recordings, folder)
        roots = dict(brought.roots)
        if root is not None:
            roots[ROOT if ROOT not in roots else f"{ROOT}_of_{folder.name}"] = root
        first = writing.FirstTwin(
            name=re.sub(r"[^A-Za-z0-9_.-]", "_", robot.stem),
            model=brought.model,
            source=_supplied_files(asset, brought),
            roots=roots,
            tcp=seen["tcp"],
            inertia_repairs=seen["inertia_repairs"],
            motors=seen["motors"],
            reading=_reading(args),
            critical=seen["critical"],
            alike=seen["alike"],
            excitation=seen["excitation"],
            servo=args.servo or "",
            servo_fit=_servo_fit(args.servo, seen["drives"], args.robot),
            servos=_servos(args.servo, seen["drives"]),
        )
        twin_file = writing.write_twin_file(folder, first)
        writing.write_schemas(folder)
        seen["notes"] += writing.write_git_files(folder)
        progress.begin("choosing goldens")
        found = sandbox.call(
            "pytest_twin.setup.inspection:first_specs",
            {"twin": str(twin_file)},
            progress=progress,
        )
        if references:
            replays = sandbox.call(
                "pytest_twin.setup.replays:first_replays",
                {
                    "twin": str(twin_file),
                    "recordings": references,
                    "tolerance": args.tolerance.to_json(),
                },
                progress=progress,
            )
            found["none"].pop("replay", None)
            found["specs"] += [{"kind": "replay", **spec} for spec in replays["specs"]]
            found["silent"] |= replays["silent"]
    if all(spec["kind"] == AUDIT for spec in found["specs"]):
        raise SpecError(
            "there is nothing to test in this model",
            path=args.robot,
            expected="a joint, a body with mass, or collision shapes of two bodies",
        )
    told = _notes(found["specs"])
    seen["notes"] += _notes_of_asset(asset, brought)
    for note in _condense(seen["notes"], robot.parent):
        show(f"note: {note}")
    specs = writing.write_specs(folder, found["specs"])
    recorded, failing, left_out, unwritten = _record(twin_file, specs)
    summary = {
        "twin": str(twin_file),
        "goldens": recorded,
        "failing": failing,
        "unwritten": unwritten,
        "left_out": left_out | found["silent"],
        "nothing_to_propose": found["none"],
        "notes": seen["notes"],
        "notes_of_goldens": told,
        "asset": None
        if asset is None or brought.manifest is None
        else {"manifest": str(brought.manifest), "copied_from": str(asset[0])},
    }
    json_output.give(args, summary)
    atomic.write_json(folder / ".twin" / "init.json", summary)
    kinds = sorted({Path(golden).parts[-2] for golden in recorded})
    show(f"{twin_file}: {len(recorded)} goldens of {len(kinds)} kinds: {', '.join(kinds)}")
    for kind, why in found["none"].items():
        show(f"nothing proposed for {kind}: {why}")
    for note, goldens in told.items():
        if note not in seen["notes"]:
            show(f"{note} ({_some(goldens)})")
    for where, why in summary["left_out"].items():
        show(f"left out: {where}: {why}")
    _show_state(failing, unwritten)
    return DONE


def _propose_anew(twin_file: Path, args: argparse.Namespace) -> int:
    if args.recordings or args.out != Path() or args.tolerance != TaskTolerance():
        raise SpecError(
            "a twin takes no recording, --tolerance or --out",
            path=args.robot,
            expected="twin.yaml alone; docs/how-to/replay_golden.md adds a replay golden",
        )
    with Runner() as runner:
        gate = Gate(twin_file, runner)
        with Sandbox(cwd=None) as sandbox, Progress("choosing goldens") as progress:
            found = sandbox.call(
                "pytest_twin.setup.inspection:first_specs",
                {"twin": str(twin_file)},
                progress=progress,
            )
            progress.begin("comparing goldens")
            anew = propose_anew(gate, found["specs"], progress)
    recorded, failing, left_out, unwritten = _record(twin_file, list(anew.written))

    def names(reasons: Mapping[Path, str]) -> dict[str, str]:
        return {path.relative_to(gate.root).as_posix(): why for path, why in reasons.items()}

    summary = {
        "twin": str(twin_file),
        "goldens": recorded,
        "replaced": names(anew.replaced),
        "unchanged": anew.kept,
        "cannot_be_compared": names(anew.broken),
        "failing": failing,
        "unwritten": unwritten,
        "left_out": left_out | found["silent"],
        "nothing_to_propose": found["none"],
        "notes": [],
        "notes_of_goldens": _notes(found["specs"]),
        "asset": None,
    }
    json_output.give(args, summary)
    show(
        f"{twin_file}: {len(recorded)} goldens proposed and recorded, "
        f"{len(anew.replaced)} of them in place of one that could not be compared; "
        f"{anew.kept} unchanged"
    )
    for golden in recorded:
        show(f"proposed: {golden}")
    for where, why in summary["left_out"].items():
        show(f"left out: {where}: {why}")
    for where, why in summary["cannot_be_compared"].items():
        show(f"cannot be compared: {where}: {why}; change it, or delete it and retire its id")
    _show_state(failing, unwritten)
    return DONE


def _show_state(failing: Mapping[str, str], unwritten: Iterable[str]) -> None:
    for why in unwritten:
        show(f"to write: {why}")
    for where, why in failing.items():
        show(f"FAILS now: {where}: {why}")
    if failing:
        show("next: pytest says why; pytest --twin-release signs once no golden fails")
    else:
        show("next: pytest --twin-release")


def _notes_of_asset(asset: tuple[Path, Manifest] | None, brought: CopiedFiles) -> Iterator[str]:
    """What the twin keeps of its asset, and which steps do not follow from the one before."""
    if asset is None or brought.manifest is None:
        return
    path, known = asset
    if path != brought.manifest:
        files = sum(file.is_file() for file in manifest.all_files(path, known))
        yield (
            f"the asset {known.asset!r} was copied to {brought.manifest.parent}, "
            f"{counted(files, 'file')} with its manifest: from now on these are the twin's own"
        )
    if not known.keeps_source:
        yield (
            f"{brought.manifest}: the supplier's files are not kept beside it, so no later change "
            "of them is seen: pytest-twin intake keeps them"
        )
    for change in manifest.changes_of_generated(path, known):
        yield (
            f"{change} after pytest-twin realize: a release needs the reason, under edited: in "
            f"{FILE_NAME}"
        )


def _some(goldens: list[str]) -> str:
    """Return names of goldens for the summary: both of two, the first of more."""
    if len(goldens) <= 2:
        return ", ".join(goldens)
    return f"{goldens[0]} and {len(goldens) - 1} more"


def _condense(notes: Iterable[str], folder: Path) -> list[str]:
    """Condense notes for the terminal: of several that differ only in names and lines, keep one.

    Repairs change the physics of a link, so all of them are kept.
    """
    kinds: dict[str, list[str]] = {}
    for note in notes:
        repair = note.endswith("(accepted repair)")
        kinds.setdefault(note if repair else _NAMES_AND_LINES.sub("", note), []).append(note)
    return [
        first.replace(f"{folder}/", "", 1)
        + (
            f" (and {counted(len(more), 'more note')} of this kind in .twin/init.json)"
            if more
            else ""
        )
        for first, *more in kinds.values()
    ]


def _servo_fit(
    servo: str | None, drives: Mapping[str, str], robot: Path
) -> dict[str, dict[str, Any]]:
    """Values of a servo for all drives of a robot, as under ``fit:``; empty without a servo."""
    if servo is None:
        return {}
    if not drives:
        raise SpecError(
            "no drive of a single joint to make a servo of", path=robot, where="--servo",
            value=servo, expected="a robot with actuators, or none of --servo",
        )  # fmt: skip
    found = find(servo)
    merged: dict[str, dict[str, Any]] = {}
    for actuator, joint in drives.items():
        for family, values in found.fit(actuator, joint).items():
            merged.setdefault(family, {}).update(values)
    return merged


def _servos(servo: str | None, drives: Mapping[str, str]) -> list[dict[str, Any]]:
    """Section ``servos:``: the parameters of a servo whose interval is known; empty without any."""
    if servo is None:
        return []
    entry = TwinServo.of(find(servo), dict.fromkeys(drives.values()))
    return [typed.plain(entry)] if entry.parameters else []


def _reading(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options for reading recordings, in the form of ``twin.yaml``."""
    topics = {"topics": args.topics} if args.topics else {}
    return topics | recording_options(args)


def _notes(specs: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Return note -> goldens that have it."""
    told: dict[str, list[str]] = {}
    for spec in specs:
        for note in spec.get("notes", ()):
            if not note.startswith(_FOR_THE_READER):
                told.setdefault(note, []).append(f"{spec['kind']} of {spec['name']}")
    return told


def _record(
    twin_file: Path, specs: list[Path]
) -> tuple[list[str], dict[str, str], dict[str, str], list[str]]:
    """Record every first golden, and remove those that cannot run on this robot.

    Returns:
        ids of recorded goldens, failing goldens -> reason, removed goldens -> reason, and goldens
            whose tolerances have to be written.
    """
    recorded: list[str] = []
    failing: dict[str, str] = {}
    left_out: dict[str, str] = {}
    unwritten: list[str] = []
    with Runner() as runner, Progress("recording goldens") as progress:
        gate = Gate(twin_file, runner)
        for done, path in enumerate(specs):
            progress(done / len(specs))
            try:
                golden = gate.golden(path)
                if golden.unwritten is not None:
                    unwritten.append(golden.unwritten)
                    continue
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
                failing[golden.id] = what(outcome)
    return recorded, failing, left_out, unwritten
