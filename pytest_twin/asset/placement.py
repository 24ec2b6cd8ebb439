"""Move the files of a realization to their folder, the manifest last."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_twin.asset import manifest
from pytest_twin.asset.manifest import Manifest, State
from pytest_twin.asset.normalize import MESH_FOLDER
from pytest_twin.errors import PathError
from pytest_twin.formats.digest import file_sha256

_NOTHING = State({})


def frozen_source(source: Path) -> tuple[Path, Manifest] | None:
    """Return the intake manifest of a source file, or None.

    Raises:
        PathError: the source has changed since intake.
        FormatError: its manifest cannot be read.
    """
    known = manifest.find(source)
    if known is None or not source.is_relative_to(known[0].parent / manifest.SOURCE_FOLDER):
        return None
    changed = manifest.changes_of_source(*known)
    if changed:
        raise PathError(
            f"the source asset has changed since intake: {changed[0]}",
            path=known[0],
            expected="the unchanged source, or a new `pytest-twin intake` of the changed one",
        )
    return known


def put_in_place(staging: Path, out: Path, source: Path, made: dict[str, Any]) -> None:
    """Move the files of ``staging`` to ``out`` and write the manifest.

    Files of an earlier run that are no longer produced are deleted. Other files in the folder
    are not changed.

    Args:
        staging: folder with the new files.
        out: target folder.
        source: the source URDF.
        made: result of ``realize``; its key ``manifest`` is set here.

    Raises:
        PathError: a file would overwrite the source, or a link has its name.
    """
    files = sorted(path for path in staging.rglob("*") if path.is_file())
    targets = {out / path.relative_to(staging): path for path in files}
    if source in targets:
        raise PathError(
            "the source would be overwritten", path=source, expected="another folder for --out"
        )
    for target in targets:
        if target.is_symlink() or target.is_dir():
            raise PathError(
                "is a link or a folder where a file has to be written",
                path=target,
                expected="nothing, or a regular file: move it, or give another folder for --out",
            )
    old = _before(out)
    told = _manifest(out, source, made, old)
    written = {
        name
        for state in ("normalized", "realization")
        for name in (old.states[state].files if old and state in old.states else ())
    }
    for target, path in targets.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        path.replace(target)
    for name in written - {target.relative_to(out).as_posix() for target in targets}:
        obsolete = out / name
        if obsolete.parent.resolve() in (out, out / MESH_FOLDER) and obsolete.is_file():
            obsolete.unlink()
    manifest.write(out / manifest.FILE_NAME, told)
    made["manifest"] = json.loads(told.to_text())


def _before(out: Path) -> Manifest | None:
    path = out / manifest.FILE_NAME
    return manifest.read(path) if path.is_file() else None


def _manifest(out: Path, source: Path, made: Mapping[str, Any], old: Manifest | None) -> Manifest:
    known = frozen_source(source)
    mine = known is not None and known[0].parent == out
    if not mine and old is not None and old.states.get("source", _NOTHING).facts.get("folder"):
        raise PathError(
            "the folder contains another asset", path=out, expected="its own URDF, or a new folder"
        )
    if known is not None:
        # The manifest of an asset lists all of its files.
        state = known[1].states["source"]
        if not mine:
            facts = {key: value for key, value in state.facts.items() if key != "folder"}
            state = State(state.files, facts)
    else:
        paths = [Path(name) for name in made["source_files"]]
        base = Path(os.path.commonpath([path.parent for path in paths]))
        state = State({p.relative_to(base).as_posix(): file_sha256(p) for p in paths})
    states = {"source": state}
    for name, content in made["states"].items():
        states[name] = State(content["files"], content["facts"])
    name = known[1].asset if known is not None and mine else made["asset"]
    return Manifest(name, states)
