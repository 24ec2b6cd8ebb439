"""``pytest-twin demo``: copy the demo arm and the example of the README, to be run at once."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import pytest_twin
from pytest_twin.commands.terminal import show
from pytest_twin.errors import PathError, of_system
from pytest_twin.formats import atomic
from pytest_twin.formats.temporary import temporary_folder

EXAMPLES = ("pytest-twin demo demo",)
EXIT_STATUS = {0: "the files are copied"}
JSON = False
_PACKAGE = Path(pytest_twin.__file__).parent
# Folder of the copy -> folder in a wheel, and in a checkout.
_SOURCES = {
    "arm/golden": (_PACKAGE / "demo/arm/golden", _PACKAGE.parent / "golden"),
    "carriage": (_PACKAGE / "demo/carriage", _PACKAGE.parent / "examples/carriage"),
}
_LEFT_OUT = ("__pycache__", ".twin", ".pytest_cache", "releases", "keys", "make")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("folder", metavar="DIR", type=Path, help="a new folder")


def run(args: argparse.Namespace) -> int:
    """Copy the files and print what to run; return 0.

    Raises:
        PathError: the folder exists, or cannot be written.
    """
    folder: Path = args.folder
    atomic.make_folder(folder.absolute().parent)
    with temporary_folder(folder.absolute().parent) as parent:
        staging = parent / "demo"
        try:
            for name, places in _SOURCES.items():
                source = next((place for place in places if place.is_dir()), places[0])
                shutil.copytree(source, staging / name, ignore=shutil.ignore_patterns(*_LEFT_OUT))
        except OSError as error:
            raise of_system(error) from None
        if not atomic.create_directory(staging, folder.absolute()):
            raise PathError("already exists", path=folder, expected="a folder that does not exist")
    for line in (
        f"pytest --twin-release {folder / 'arm'}    # test and sign the demo arm",
        f"pytest {folder / 'carriage'}    # a failing test that names the missing physics",
    ):
        show(line)
    return 0
