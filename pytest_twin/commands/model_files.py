"""The options ``--root`` and ``--package`` of every command that reads a model."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

from pytest_twin.errors import SpecError
from pytest_twin.formats.declared_inputs import DeclaredInputs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options ``root`` and ``package``."""
    add_root(parser)
    parser.add_argument(
        "--package",
        metavar="NAME=DIR",
        action="append",
        default=[],
        help="folder of a package:// that is not found near the model; may be repeated",
    )


def add_root(parser: argparse.ArgumentParser) -> None:
    """Declare the option ``root``."""
    parser.add_argument(
        "--root",
        metavar="DIR",
        action="append",
        default=[],
        type=Path,
        help="another folder from which meshes, textures, includes, recordings and images may be "
        "read and in which links may end, in addition to the model's own root (its package, its "
        "checkout, or the nearest folder that contains all files that it names); may be repeated",
    )


def declared_inputs(args: argparse.Namespace) -> DeclaredInputs:
    """Return the folders of the two options, and the files and folders that the user named.

    Raises:
        SpecError: a package has no name, or a folder does not exist.
    """
    packages = {}
    for word in getattr(args, "package", []):
        name, equals, folder = word.partition("=")
        if not (name and equals and Path(folder).is_dir()):
            raise SpecError(
                "no package", where="--package", value=word, expected="NAME=DIR, a folder"
            )
        packages[name] = Path(folder).resolve()
    roots = getattr(args, "root", [])
    for root in roots:
        if not root.is_dir():
            raise SpecError("no such folder", where="--root", value=root, expected="a folder")
    # Who names a link on the command line means the file behind it.
    named = [path for path in _paths(vars(args).values()) if path.is_symlink()]
    return DeclaredInputs(tuple(path.resolve() for path in (*roots, *named)), packages)


def _paths(values: Iterable[object]) -> Iterator[Path]:
    for value in values:
        if isinstance(value, Path):
            yield value
        elif isinstance(value, list):
            yield from _paths(value)
