"""``--package NAME=FOLDER``, the same for every command that reads a URDF."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin.errors import SpecError


def add_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the option, ``package``."""
    parser.add_argument(
        "--package",
        metavar="NAME=FOLDER",
        action="append",
        default=[],
        help="where a package:// of the URDF lies, when it is not found above the file",
    )


def parse(words: list[str]) -> dict[str, str]:
    """Package -> absolute folder.

    Raises:
        SpecError: no name, or no such folder.
    """
    found = {}
    for word in words:
        name, equals, folder = word.partition("=")
        if not (name and equals and Path(folder).is_dir()):
            raise SpecError(
                "no package", where="--package", value=word, expected="NAME=FOLDER that exists"
            )
        found[name] = str(Path(folder).resolve())
    return found
