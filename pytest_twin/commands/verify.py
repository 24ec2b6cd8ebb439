"""``pytest-twin verify``: check a release, or the stamp of a data set."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from pytest_twin import release
from pytest_twin.commands import json_output
from pytest_twin.commands.release_folder import RELEASE_HELP, release_folder
from pytest_twin.commands.terminal import show_lines
from pytest_twin.errors import ReleaseError, TwinError
from pytest_twin.formats.stamps import is_carrier
from pytest_twin.gate.coverage import Gap, gaps
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.release import stamps
from pytest_twin.release.envelope import short_key_id
from pytest_twin.release.environment import engine_changes
from pytest_twin.release.folder import RELEASES
from pytest_twin.release.rollback import changed_files
from pytest_twin.release.stamp import StampVerdict
from pytest_twin.release.verify import ENVELOPE
from pytest_twin.twin import FILE_NAME, load_twin
from pytest_twin.words import counted, list_names

EXAMPLES = (
    "pytest-twin verify releases/0001",
    "pytest-twin verify datasets/pick",
    "pytest-twin verify received/ --keys trusted-keys/ --json -",
)
EXIT_STATUS = {
    0: "the release or the stamp is valid",
    1: "it is not valid; each reason is listed",
}
HOLDS, DOES_NOT_HOLD = 0, 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "release",
        metavar="RELEASE|DATASET",
        type=Path,
        help=f"{RELEASE_HELP} and its records; or a stamped data set or policy",
    )
    parser.add_argument(
        "--keys",
        metavar="DIR",
        type=Path,
        help="folder of trusted public keys (default: keys/ of the twin)",
    )


def run(args: argparse.Namespace) -> int:
    """Verify; return 0 if the release or stamp is valid, else 1.

    Raises:
        TwinError: the input is missing, or no keys can be read.
    """
    if args.keys is not None and not args.keys.is_dir():
        raise ReleaseError(
            "no such folder of keys",
            path=args.keys,
            expected="a folder with the public keys (.pub) of those who may sign",
        )
    if not _is_release(args.release) and is_carrier(args.release):
        return _verify_stamps(args)
    folder = release_folder(args.release)
    if args.json not in (None, json_output.STANDARD_OUTPUT):
        _check_outside(Path(args.json), folder)
    verdict = release.check(folder, keys=args.keys, remember=True)
    twin_file: Path = args.release / FILE_NAME
    differences: list[str] = []
    if args.release != folder and twin_file.is_file():
        differences = _changed_since(args.release, verdict.release)
        verdict = replace(verdict, problems=(*verdict.problems, *_stale_records(twin_file)))
    proofs = [] if verdict.release is None else verdict.release.goldens.values()
    untested = gaps([proof.outcome for proof in proofs])
    engines = [] if verdict.release is None else engine_changes(verdict.release)
    json_output.give(
        args,
        verdict.to_json()
        | {
            "path": str(folder),
            "not_tested": [gap.sentence for gap in untested],
            "changed_since": differences,
            "engines": engines,
        },
    )
    show_lines([*_words(verdict, folder, untested, differences), *(f"  {e}" for e in engines)])
    return HOLDS if verdict.holds else DOES_NOT_HOLD


def _changed_since(root: Path, released: release.Release | None) -> list[str]:
    """Files of the twin that differ from those of a release; the release itself may be valid."""
    if released is None:
        return []
    try:
        return [change.path for change in changed_files(root, released)]
    except TwinError as error:
        return [str(error)]


def _stale_records(twin_file: Path) -> Iterator[release.ReleaseProblem]:
    """Problems of the twin as it is today: records whose inputs have changed."""
    try:
        if not load_twin(twin_file).has_records:
            return
        with Sandbox() as sandbox:
            lines = sandbox.call(
                "pytest_twin.realization.record_inputs:stale_record_lines",
                {"twin": str(twin_file.absolute())},
            )
    except TwinError as error:
        lines = [f"its records cannot be compared with their inputs: {error}"]
    yield from (release.ReleaseProblem("records", line) for line in lines)


def _verify_stamps(args: argparse.Namespace) -> int:
    dataset: Path = args.release
    found = stamps.read(dataset)
    verdicts = stamps.judge(found, stamps.keys_of(dataset, found, args.keys))
    holds = all(verdict.holds for verdict in verdicts.values())
    first = next((one.stamp for one in found if one.stamp is not None), None)
    listed = [
        {
            "path": str(path),
            "holds": verdict.holds,
            "problems": list(verdict.problems),
            "note": verdict.note,
        }
        for path, verdict in verdicts.items()
    ]
    json_output.give(
        args,
        {
            **_as_verdict(list(verdicts.values())).to_json(),
            "path": str(dataset),
            "stamp": None if first is None else {**first.ids, "stamped": first.stamped},
            "files": listed,
        },
    )
    of = "" if first is None else f": {first.name}, stamped {first.stamped}"
    lines = [f"{'holds' if holds else 'does not hold'}: {dataset}{of}"]
    if holds:
        lines.append(f"  {counted(len(found), 'stamped file')}, signed by a trusted key")
    lines += [f"  {path}: {problem}" for path, v in verdicts.items() for problem in v.problems]
    lines += [f"  note: {path}: {v.note}" for path, v in verdicts.items() if v.note]
    show_lines(lines)
    return HOLDS if holds else DOES_NOT_HOLD


def _as_verdict(verdicts: Sequence[StampVerdict]) -> release.Verdict:
    problems = (text for verdict in verdicts for text in verdict.problems)
    authentic = next((v.release for v in verdicts if v.release is not None), None)
    return release.Verdict(
        authentic, tuple(release.ReleaseProblem("stamp", text) for text in problems)
    )


def _is_release(given: Path) -> bool:
    """Whether to verify a release: its folder may contain copies of recordings as well."""
    return given.parent.name == RELEASES or any(
        (given / name).exists() for name in (ENVELOPE, FILE_NAME, RELEASES)
    )


def _check_outside(path: Path, folder: Path) -> None:
    if path.resolve().is_relative_to(folder.resolve()):
        raise ReleaseError(
            "is inside the release and would invalidate it", path=path, expected="another folder"
        )


def _words(
    verdict: release.Verdict, folder: Path, untested: Sequence[Gap], differences: Sequence[str]
) -> list[str]:
    found = verdict.release
    if found is None:
        lines = [f"does not hold: {folder}"]
    else:
        header = found.header
        name = f"release {header.number} of {header.twin!r}"
        changed = (f"{counted(len(differences), 'file')} changed since",) if differences else ()
        name = ", ".join((name, *(gap.name for gap in untested), *changed))
        lines = [f"holds: {name}" if verdict.holds else f"does not hold: {name}"]
        lines.append(
            f"  made {header.created}, valid until {header.expires}, "
            f"signed by {short_key_id(header.key_id)}"
        )
        if verdict.holds:
            outside = len(found.external)
            also = f"; {counted(outside, 'file')} outside it, by digest" if outside else ""
            lines.append(
                f"  {counted(len(found.goldens), 'golden')}, "
                f"{counted(len(found.files), 'file')} in the release{also}"
            )
    lines += [f"  {gap.sentence}" for gap in untested]
    if differences:
        lines.append(
            f"  the twin is not the released one: {list_names(differences)} changed or gone; "
            "pytest --twin-why says what is stale"
        )
    lines += [f"  {problem.text}" for problem in verdict.problems]
    return lines
