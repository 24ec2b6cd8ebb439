"""``pytest-twin rollback``: restore the files of a twin's last valid release."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from pytest_twin.commands import json_output
from pytest_twin.commands.terminal import show
from pytest_twin.errors import ReleaseError
from pytest_twin.release.restore import last_validated, restore
from pytest_twin.report.text import printable
from pytest_twin.twin import find_twin
from pytest_twin.words import counted

HELP = "restore the files of the last signed release of a twin"
EXAMPLES = ("pytest-twin rollback", "pytest-twin rollback --release releases/0006 --json -")
EXIT_STATUS = {0: "the twin's files are those of the release"}
DONE = 0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--twin",
        metavar="DIR",
        type=Path,
        default=Path(),
        help="folder of the twin, or a folder in it (default: the working directory)",
    )
    parser.add_argument(
        "--release",
        metavar="RELEASE",
        type=Path,
        help="folder of the release (default: the newest one that is signed and undamaged, and "
        "differs from the twin's files)",
    )


def run(args: argparse.Namespace) -> int:
    """Restore the files; return 0.

    Raises:
        ReleaseError: no twin, or the release is unsigned, damaged, or signed by an untrusted key.
    """
    file = find_twin(args.twin)
    if file is None:
        raise ReleaseError(
            "no twin here", path=args.twin, expected="a folder at or below one with a twin.yaml"
        )
    root = file.parent
    folder = args.release.absolute() if args.release else last_validated(root, datetime.now(UTC))
    if folder.parent.parent.resolve() != root.resolve():
        raise ReleaseError(
            "a release of another twin", path=folder, expected=f"a folder in {root / 'releases'}"
        )
    done = restore(root, folder)
    number = done.release.number
    json_output.give(
        args,
        {
            "schema": 1,
            "twin": done.release.twin,
            "release": number,
            "replaced": list(done.replaced),
            "kept": None if done.kept is None else str(done.kept),
        },
    )
    lines = [
        f"restored: release {number} of {done.release.twin!r} "
        f"({counted(len(done.replaced), 'file')} replaced)",
        *(f"  {name}" for name in done.replaced),
    ]
    if done.kept is not None:
        lines.append(f"  replaced files are kept in: {done.kept}")
    lines.append("next: pytest --twin-release (a later release follows it; none is taken back)")
    show("\n".join(printable(line) for line in lines))
    return DONE
