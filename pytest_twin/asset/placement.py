"""Add the manifest to the files of a realization."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pytest_twin.asset import manifest
from pytest_twin.asset.manifest import Manifest, State
from pytest_twin.errors import PathError
from pytest_twin.formats.digest import file_sha256


def frozen_source(source: Path) -> tuple[Path, Manifest] | None:
    """Return the intake manifest of a source file, or None.

    Raises:
        PathError: the source has changed since intake.
        FormatError: its manifest cannot be read.
    """
    known = manifest.find(source)
    if known is None or not source.is_relative_to(known[0].parent / manifest.SOURCE_FOLDER):
        return None
    manifest.require_unchanged_source(*known)
    return known


def require_in_source(files: Iterable[Path], path: Path, known: Manifest) -> None:
    """Check that the files of a xacro file are in the source that intake keeps.

    Raises:
        PathError: a file is elsewhere, so that no later change of it would be seen.
    """
    for file in files:
        if _name_below(file, path.parent) not in known.states["source"].files:
            raise PathError(
                "the source includes a file that intake does not keep, so that a later change of "
                "it would not be seen",
                path=file,
                expected="one folder with all packages for pytest-twin intake",
            )


def complete(staging: Path, out: Path, source: Path, made: dict[str, Any]) -> None:
    """Add the manifest, and the supplier's files that it lists, to the files of a realization.

    Args:
        staging: folder with the new files.
        out: folder of the asset, to which they will be moved.
        made: result of ``realize``; its key ``manifest`` is set here.

    Raises:
        PathError: a file would overwrite the source, or ``out`` has another asset.
    """
    names = sorted(p.relative_to(staging).as_posix() for p in staging.rglob("*") if p.is_file())
    if any(out / name == source for name in names):
        raise PathError(
            "the source would be overwritten", path=source, expected="another folder for --out"
        )
    listed, copied = _manifest(out, source, made, _before(out), names)
    for name, path in copied.items():
        (staging / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, staging / name)
    manifest.write(staging / manifest.FILE_NAME, listed)
    made["manifest"] = json.loads(listed.to_text())


def _before(out: Path) -> Manifest | None:
    path = out / manifest.FILE_NAME
    return manifest.read(path) if path.is_file() else None


def _manifest(
    out: Path,
    source: Path,
    made: Mapping[str, Any],
    old: Manifest | None,
    names: Iterable[str],
) -> tuple[Manifest, dict[str, Path]]:
    """Return the new manifest, and the files of the source that have to be copied to ``out``."""
    known = frozen_source(source)
    copied: dict[str, Path] = {}
    read_files = [Path(name) for name in made["source_files"]]
    if known is not None:
        # The manifest of an asset lists all of its files.
        base, state = known[0].parent, known[1].states["source"]
    else:
        base = Path(os.path.commonpath([path.parent for path in read_files]))
        state = State({p.relative_to(base).as_posix(): file_sha256(p) for p in read_files})
    if known is None or base != out:
        if old is not None and old.keeps_source and old.states["source"].files != state.files:
            raise PathError(
                "the folder contains another asset",
                path=out,
                expected="its own URDF, or a new folder",
            )
        if known is not None and (old is None or not old.keeps_source):
            # The source goes with the asset, so that the gate sees a later change of it.
            copied = {name: base / name for name in state.files}
    read_names = [_name_below(path, base) for path in read_files]
    command = [*made["command"]]
    command[2] = _name_below(source, base)
    states = {"source": state}
    link = manifest.link_to("source", state, (n for n in read_names if n in state.files))
    for name in ("normalized", "realization"):
        content = made["states"][name]
        facts = {"made": manifest.made_by(command, link), **content["facts"]}
        states[name] = State(content["files"], facts)
        link = manifest.link_to(name, states[name], content["files"])
    in_a_state = {file for state in states.values() for file in state.files}
    reports = [name for name in names if name not in in_a_state]
    states["normalized"] = State(
        states["normalized"].files, {**states["normalized"].facts, manifest.REPORTS: reports}
    )
    return Manifest(known[1].asset if known is not None else made["asset"], states), copied


def _name_below(path: Path, base: Path) -> str:
    return path.relative_to(base).as_posix() if path.is_relative_to(base) else path.name
