"""Expand the xacro file of a command, in a confined child process."""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from pytest_twin.errors import SpecError
from pytest_twin.formats import atomic
from pytest_twin.formats.declared_inputs import declared_inputs, declaring
from pytest_twin.formats.expansions import SUFFIX, Expansion
from pytest_twin.formats.temporary import temporary_folder
from pytest_twin.realization.confinement import why_not_confined
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.realization.xacro_file import ROS_VARIABLES, command, readable_folders

_MEMORY_BYTES = 2 * 2**30
"""Memory limit of the process that expands a file."""
_SECONDS = 120.0
"""Time limit of the process that expands a file."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the option ``xacro``."""
    parser.add_argument(
        "--xacro",
        metavar="ARG:=VALUE",
        action="append",
        default=[],
        help="argument of a xacro file; may be repeated",
    )


@contextmanager
def expanded(path: Path, args: argparse.Namespace) -> Iterator[Expansion | None]:
    """Read a xacro file as the URDF that it expands to, while the context is open.

    Args:
        path: absolute path of a model; one that is no xacro file is not changed.

    Raises:
        TwinError: the file cannot be expanded here, or xacro refuses it.
    """
    arguments = _arguments(args.xacro)
    if path.suffix != SUFFIX:
        if arguments:
            raise SpecError(
                "not a xacro file", path=path, where="--xacro", expected="a file NAME.xacro"
            )
        yield None
        return
    _require(path, arguments)
    environment = {name: os.environ[name] for name in ROS_VARIABLES if name in os.environ}
    with (
        temporary_folder() as folder,
        Sandbox(
            memory_bytes=_MEMORY_BYTES,
            seconds=_SECONDS,
            confined_to=readable_folders(path, environment),
        ) as sandbox,
    ):
        answer = sandbox.call(
            "pytest_twin.realization.xacro_file:expand",
            {
                "source": str(path),
                "arguments": arguments,
                "environment": environment,
                "variables": sorted(os.environ),
            },
        )
        sandbox.close()
        urdf = folder / "expanded.urdf"
        atomic.write_text(
            urdf,
            f"<!-- Expanded by xacro from {path.name}, as: "
            f"{command(path, arguments).replace('--', '- -')} -->\n{answer['text']}\n",
        )
        expansion = Expansion(
            path, urdf, tuple(map(Path, answer["read"])), arguments,
            tuple(map(Path, answer["packages"].values())),
        )  # fmt: skip
        with declaring(replace(declared_inputs(), expansion=expansion)):
            yield expansion


def delivery_of(expansion: Expansion) -> list[Path]:
    """Folders of all packages of a xacro file: what intake has to keep so that it can be expanded.

    A file without a package brings its folder.

    Raises:
        SpecError: a file that it includes is in none of them.
    """
    declared = declared_inputs()
    folders = [_package_of(expansion.read[0]) or expansion.read[0].parent]
    folders += [folder for file in expansion.read if (folder := _package_of(file)) is not None]
    folders += [folder.resolve() for folder in (*expansion.packages, *declared.packages.values())]
    once = list(dict.fromkeys(folders))
    outer = [one for one in once if not any(one != two and one.is_relative_to(two) for two in once)]
    for file in expansion.read:
        if not any(file.is_relative_to(folder) for folder in outer):
            raise SpecError(
                "a xacro file includes a file that is in no package", path=file,
                expected=f"a folder with {expansion.source.name} and all its files: pytest-twin "
                "intake FOLDER --out DIR",
            )  # fmt: skip
    names = [folder.name for folder in outer]
    if len(set(names)) < len(names):
        raise SpecError(
            "two packages have folders of one name", path=expansion.source,
            value=", ".join(map(str, outer)), expected="different names",
        )  # fmt: skip
    return outer


def place_in_delivery(path: Path, source: Path) -> Path:
    """Path of a xacro file in the folder to which intake copied its packages."""

    def shared_parts(copied: Path) -> int:
        pairs = zip(reversed(copied.parts), reversed(path.resolve().parts), strict=False)
        return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))

    return max(source.rglob(path.resolve().name), key=shared_parts)


def _package_of(file: Path) -> Path | None:
    return next((one for one in file.parents if (one / "package.xml").is_file()), None)


def _arguments(words: list[str]) -> dict[str, str]:
    arguments = {}
    for word in words:
        name, separator, value = word.partition(":=")
        if not (name and separator):
            raise SpecError(
                "not an argument of xacro", where="--xacro", value=word, expected="ARG:=VALUE"
            )
        arguments[name] = value
    return arguments


def _require(path: Path, arguments: dict[str, str]) -> None:
    """Check that this machine can expand a xacro file without a risk.

    Raises:
        SpecError: it cannot.
    """
    by_hand = f"the URDF that xacro writes: {command(path, arguments)}"
    if importlib.util.find_spec("xacro") is None:
        raise SpecError(
            "a xacro file, and the package xacro is not installed",
            path=path,
            expected=f"pip install 'pytest-twin[xacro]', or {by_hand}",
        )
    problem = why_not_confined()
    if problem is not None:
        raise SpecError(
            f"a xacro file runs code, and this machine cannot confine it: {problem}",
            path=path,
            expected=by_hand,
        )
