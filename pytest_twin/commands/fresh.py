"""``pytest-twin fresh``: list changes of a twin since a data set was stamped."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pytest_twin import release
from pytest_twin.commands import json_output, model_files
from pytest_twin.commands.progress import Progress
from pytest_twin.commands.release_folder import TWIN_HELP, twin_folder
from pytest_twin.commands.terminal import show_lines
from pytest_twin.errors import ReleaseError
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.gate.asset_chain import chain_of, changes_since, lost_manifests
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.release import stamps
from pytest_twin.release.environment import engine_changes
from pytest_twin.release.released_files import copy_release, release_folder
from pytest_twin.twin import FILE_NAME, load_twin
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin fresh datasets/pick",
    "pytest-twin fresh policy.onnx --twin cell/ --json -",
)
EXIT_STATUS = {
    0: "no change affects these data",
    1: "a change affects these data; each change and its size are listed",
}
FRESH, STALE = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "dataset", metavar="DATASET", type=Path, help="a stamped data set or policy"
    )
    parser.add_argument(
        "--twin",
        metavar="TWIN",
        type=Path,
        help=f"{TWIN_HELP} (default: the twin above DATASET or the working directory, "
        "else the folder from which the data set was stamped)",
    )
    model_files.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """List the changes; return 0 if none matters to the data, else 1.

    Raises:
        TwinError: the stamp is invalid, or the twin or the release is missing.
    """
    dataset: Path = args.dataset
    found = stamps.read(dataset)
    root = stamps.twin_that_stamped(dataset, found) if args.twin is None else twin_folder(args.twin)
    stated, notes = _stamped_release(dataset, found, root)
    folder = release_folder(root, stated.number)
    with (
        temporary_folder() as scratch,
        Sandbox() as sandbox,
        Progress("comparing"),
    ):
        before = copy_release(stated, folder, root, Path(scratch).resolve())
        document = sandbox.call(
            "pytest_twin.provenance.differences:differences",
            {
                "before": str(before),
                "today": str(root / FILE_NAME),
                "dataset": str(dataset.absolute()),
                "stamped": stamps.variants(found),
                "joints": next(one.stamp.joints for one in found if one.stamp is not None),
            },
        )
    document["notes"] += notes
    newest = release.newest(root)
    twin = load_twin(root / FILE_NAME)
    chain = chain_of(twin)
    document = {
        "schema": 1,
        "dataset": str(dataset),
        "twin": stated.twin,
        "release": stated.number,
        "newest": None if newest is None else int(newest.name),
        **document,
        "engines": engine_changes(stated),
        "asset": [
            *changes_since(stated, chain),
            *(f"asset: {p}" for p in (*chain.problems, *lost_manifests(stated, chain, twin))),
        ],
    }
    json_output.give(args, document)
    show_lines(_words(document))
    return FRESH if document["verdict"] == "fresh" else STALE


def _stamped_release(
    dataset: Path, found: list[stamps.StampedFile], root: Path
) -> tuple[release.Release, list[str]]:
    """Return the release of the stamp, after verifying the stamp, and notes on the data."""
    verdicts = stamps.judge(found, stamps.keys_of(dataset, found, root / "keys"))
    for path, verdict in verdicts.items():
        if not verdict.holds or verdict.release is None:
            raise ReleaseError(
                f"its stamp does not hold: {verdict.problems[0]}",
                path=path,
                expected="a stamp that pytest-twin verify accepts",
            )
    stated = next(iter(verdicts.values())).release
    assert stated is not None
    return stated, [f"{path.name}: {v.note}" for path, v in verdicts.items() if v.note]


def _words(document: dict[str, Any]) -> list[str]:
    """Return the summary for people, relevant changes first."""
    changes = document["changes"]
    matter = [one for one in changes if one["matters"]]
    verdict = "fresh" if document["verdict"] == "fresh" else "not fresh"
    lines = [
        f"{verdict}: {document['dataset']}, made with release {document['release']} of "
        f"{document['twin']!r} (newest release: {document['newest']})"
    ]
    if not changes:
        unchanged = "no model, calibration or fit" if document["asset"] else "nothing"
        lines.append(f"  {unchanged} has changed in the twin since")
    lines += [f"  {line}" for line in (*document["asset"], *document["engines"])]
    for title, some in (("matters", matter), ("does not matter", changes)):
        for one in some:
            if title == "does not matter" and one["matters"]:
                continue
            lines.append(f"  {title}: {one['part']}: {'; '.join(map(_change, one['changed']))}")
            lines.append(f"    {one['why']}")
    total = document["moved"]
    if total is not None:
        lines.append(
            f"  together: {document['tcp']!r} moves by up to {1e3 * total['translation']:.3g} mm "
            f"and {1e3 * total['rotation']:.3g} mrad {document['poses']['source']} "
            f"(root mean square {1e3 * total['translation_rms']:.3g} mm)"
        )
    bound = document["tolerance"]
    if changes:
        lines.append(
            f"  {len(matter)} of {counted(len(changes), 'change')} beyond "
            f"{1e3 * bound['translation']:g} mm or {1e3 * bound['rotation']:g} mrad, or of "
            f"unknown size ('fresh:' in {FILE_NAME})"
        )
    return [*lines, *(f"  note: {note}" for note in document["notes"])]


def _change(one: dict[str, Any]) -> str:
    if not one["field"]:
        return "changed"
    values = f" {one['old']} -> {one['new']}" if one["old"] or one["new"] else ""
    return f"{one['field']}{values}"
