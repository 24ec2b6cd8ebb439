"""``--root`` and ``--package``: the same for every command that reads a model."""

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
        help="a folder that meshes, textures and includes may lie in beside the model's own root, "
        "which is found (its package, its checkout, or the nearest folder that holds every file "
        "that it names); once for each",
    )
    parser.add_argument(
        "--package",
        metavar="NAME=DIR",
        action="append",
        default=[],
        help="the folder of a package:// that is not found around the model; once for each",
    )


def search_folders(args: argparse.Namespace) -> SearchFoldersJson:
    """The folders that the two options name, absolute, as a child process gets them.

    Raises:
        SpecError: no name, or no such folder.
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
