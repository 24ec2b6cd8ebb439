"""Audit one robot file in a child process, and write its report."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from pytest_twin.commands import xacro_files
from pytest_twin.commands.progress import Progress
from pytest_twin.formats import atomic, results
from pytest_twin.formats.expansions import EXPANDED
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.report.audit import render


def audit_robot(
    asset: Path, out: Path, call: tuple[str, dict[str, object]], args: argparse.Namespace
) -> tuple[dict[str, Any], list[str]]:
    """Audit a file, and write ``NAME.audit.json`` and ``NAME.audit.html``.

    Args:
        asset: the robot's file; a xacro file is expanded.
        out: folder of the report.
        call: function of the child process, and its arguments.
        args: arguments with ``xacro``.

    Returns:
        The JSON document, and lines on files that were found for the user.

    Raises:
        TwinError: the file cannot be read.
    """
    function, arguments = call
    name = f"{asset.name}.audit"
    with (
        xacro_files.expanded(asset.resolve(), args) as expansion,
        results.result_folder(out, f"{name}.json") as staging,
        Sandbox() as sandbox,
        Progress("auditing") as progress,
    ):
        document = sandbox.call(function, arguments, progress=progress)
        if expansion is not None:
            shutil.copyfile(expansion.urdf, staging / f"{name}{EXPANDED}")
        renders = document.pop("renders", [])
        located = document.pop("located", [])
        atomic.write_json(staging / f"{name}.json", document)
        atomic.write_text(staging / f"{name}.html", render(document, renders))
    return document, located
