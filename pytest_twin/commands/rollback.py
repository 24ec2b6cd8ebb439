"""``pytest-twin rollback``: restore the files of a twin's last valid release."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin.commands import json_output
from pytest_twin.commands.release_folder import RELEASE_HELP, TWIN_HELP, release_folder
from pytest_twin.commands.terminal import show_lines
from pytest_twin.errors import ReleaseError
from pytest_twin.release.rollback import Rollback, plan, restore, resume
from pytest_twin.twin import FILE_NAME, PENDING_ROLLBACK
from pytest_twin.words import counted

EXAMPLES = (
    "pytest-twin rollback --dry-run",
    "pytest-twin rollback --release releases/0006 --json -",
)
EXIT_STATUS = {0: "the twin's files are those of the release, or would be with --dry-run"}
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--twin",
        metavar="TWIN",
        type=Path,
        default=Path(),
        help=f"{TWIN_HELP} (default: the twin in or above the working directory)",
    )
    parser.add_argument(
        "--release",
        metavar="RELEASE",
        type=Path,
        help=f"{RELEASE_HELP} (default: the newest one that is signed and undamaged)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="list the files that would be replaced"
    )


def run(args: argparse.Namespace) -> int:
    """Restore the files; return 0.

    Raises:
        ReleaseError: no twin, or the release is unsigned, damaged, or signed by an untrusted key.
    """
    root = _root(args.twin)
    folder: Path | None = None
    if args.release is not None:
        folder = release_folder(args.release).absolute()
        if folder.parent.parent.resolve() != root.resolve():
            raise ReleaseError(
                "a release of another twin",
                path=folder,
                expected=f"a folder in {root / 'releases'}",
            )
    lines: list[str] = []
    is_pending = (root / PENDING_ROLLBACK).is_dir()
    if is_pending and args.dry_run:
        lines.append("an interrupted rollback is completed first")
    resumed = None if args.dry_run else resume(root)
    if resumed is not None:
        lines.append(f"completed the interrupted rollback to release {resumed.number}")
    if resumed is not None and folder is None:
        done = resumed
    else:
        done = plan(root, folder) if args.dry_run else restore(root, folder)
    json_output.give(
        args,
        {
            "schema": 1,
            "twin": done.twin,
            "release": done.number,
            "replaced": [change.path for change in done.changes],
            "kept": None if done.copies is None else str(done.copies),
            "dry_run": args.dry_run,
            "resumed": is_pending,
        },
    )
    show_lines((*lines, *_words(done, root, args.dry_run)))
    return DONE


def _root(given: Path) -> Path:
    """The folder of the twin at or above a folder; its ``twin.yaml`` may be missing so far."""
    given = (given.parent if given.name == FILE_NAME else given).absolute()
    for folder in (given, *given.parents):
        if (folder / FILE_NAME).is_file() or (folder / PENDING_ROLLBACK).is_dir():
            return folder
    raise ReleaseError(
        "no twin here", path=given, expected="a folder at or below one with a twin.yaml"
    )


def _words(done: Rollback, root: Path, dry_run: bool) -> list[str]:
    lines = list(done.notes)
    if not done.changes:
        lines.append(
            f"nothing to restore: the files are those of release {done.number} of {done.twin!r}; "
            f"--release {root / 'releases'}/NUMBER restores an earlier one"
        )
        return lines
    lines.append(
        f"{'would restore' if dry_run else 'restored'}: release {done.number} of {done.twin!r} "
        f"({counted(len(done.changes), 'file')} replaced)"
    )
    lines += [f"  {one.path}" + " (new)" * (one.before is None) for one in done.changes]
    if done.copies is not None:
        lines.append(f"  replaced files are kept in: {done.copies}")
    if not dry_run:
        lines.append("next: pytest --twin-release (a later release follows it; none is taken back)")
    return lines
