"""The options ``--root`` and ``--package`` of every command that reads a model."""

from __future__ import annotations

import argparse
from pathlib import Path

from pytest_twin.errors import SpecError
from pytest_twin.realization.files.search import SearchFolders, SearchFoldersJson


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options ``root`` and ``package``."""
    parser.add_argument(
        "--root",
        metavar="DIR",
        action="append",
        default=[],
        type=Path,
        help="another folder from which meshes, textures and includes may be read, in addition to "
        "the model's own root (its package, its checkout, or the nearest folder that contains all "
        "files that it names); may be repeated",
    )
    parser.add_argument(
        "--package",
        metavar="NAME=DIR",
        action="append",
        default=[],
        help="folder of a package:// that is not found near the model; may be repeated",
    )


def search_folders(args: argparse.Namespace) -> SearchFoldersJson:
    """Return the folders of the two options as absolute paths, for a child process.

    Raises:
        SpecError: a package has no name, or a folder does not exist.
    """
    packages = {}
    for word in args.package:
        name, equals, folder = word.partition("=")
        if not (name and equals and Path(folder).is_dir()):
            raise SpecError(
                "no package", where="--package", value=word, expected="NAME=DIR, a folder"
            )
        packages[name] = Path(folder).resolve()
    for root in args.root:
        if not root.is_dir():
            raise SpecError("no such folder", where="--root", value=root, expected="a folder")
    return SearchFolders(tuple(root.resolve() for root in args.root), packages).to_json()
