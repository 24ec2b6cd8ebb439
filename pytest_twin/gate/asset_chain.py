"""The chain from a supplier's archive to the models of a twin: intake, realize, twin.yaml."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pytest_twin.asset import manifest
from pytest_twin.asset.manifest import FileChange, Manifest
from pytest_twin.errors import TwinError
from pytest_twin.formats import xml
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import read_bytes
from pytest_twin.twin import FILE_NAME, Twin

if TYPE_CHECKING:
    from pytest_twin.release import Release

_MAX_NAMED = 3
"""Largest number of changed files in a message."""
_INIT_SUMMARY = ".twin/init.json"
_SUMMARY_BYTES = 16 * 2**20
"""Largest size of the summary of ``init``."""


@dataclass(frozen=True, slots=True)
class AssetChain:
    """The assets of a twin, from the supplier's archive to the models.

    Attributes:
        content: manifest, relative to the twin's folder -> digests of the manifest and of each
            state, what made it from which state, the models among its files, and stated edits.
        notes: assets whose files no model of the twin is among, one line each.
        problems: what no longer follows from the step before, one line each.
        files: files that a release depends on, by way of a manifest.
        unread: manifests that cannot be read.
    """

    content: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    unread: frozenset[Path] = frozenset()


def chain_of(twin: Twin) -> AssetChain:
    """Read the manifests of a twin's models and sources, and compare them with the files."""
    content: dict[str, Any] = {}
    problems: list[str] = []
    files: dict[Path, None] = {}
    stated: set[Path] = set()
    unread: set[Path] = set()
    for file in _referenced(twin):
        try:
            asset = manifest.find(file)
        except TwinError as error:
            problems.append(str(error))
            unread |= {error.path} if error.path is not None else set()
            continue
        name = None if asset is None else os.path.relpath(asset[0], twin.root)
        if asset is None or name is None or name in content:
            continue
        path, known = asset
        problems += _problems_of_source(path, manifest.changes_of_source(path, known))
        changed = manifest.changes_of_generated(path, known)
        edits = {path.parent / one.file: one for one in changed}
        stated |= edits.keys()
        problems += [
            _problem_of_edit(path, known, one, twin)
            for edited, one in edits.items()
            if edited not in twin.edited
        ]
        content[name] = _content(path, known, [f for f in edits if f in twin.edited], twin)
        files.update(dict.fromkeys(_files(path, known)))
    problems += [
        str(
            twin.error(
                f"edited.{os.path.relpath(path, twin.root)}",
                "the file is as pytest-twin realize wrote it, or not a generated file",
                value=edit.reason,
                expected="a generated file of an asset that a person has changed",
            )
        )
        for path, edit in twin.edited.items()
        if path not in stated
    ]
    problems += _problems_of_original(twin)
    return AssetChain(
        content=content,
        notes=tuple(
            f"asset: {name}: no model of this twin is among its files, so nothing states what the "
            "model was made from"
            for name, asset in content.items()
            if not asset["models"]
        ),
        problems=tuple(dict.fromkeys(problems)),
        files=tuple(files),
        unread=frozenset(unread),
    )


def _referenced(twin: Twin) -> Iterable[Path]:
    models = (reference.file for reference in twin.realizations.values())
    return dict.fromkeys((*twin.source, *models))


def changes_since(release: Release, today: AssetChain) -> Iterator[str]:
    """Yield one line for each step of the chain that differs from that of a release."""
    before = release.ids.get("chain", {})
    for name in sorted(before.keys() | today.content.keys()):
        old, new = before.get(name), today.content.get(name)
        if old == new:
            continue
        since = f"since release {release.number:04d}"
        if old is None or new is None:
            yield f"asset: {name} {'is new' if old is None else 'is not read any more'} {since}"
            continue
        steps = [
            f"{step} {old['states'].get(step, {}).get('digest', 'absent')[:12]} -> "
            f"{new['states'].get(step, {}).get('digest', 'absent')[:12]}"
            for step in manifest.STATES
            if old["states"].get(step) != new["states"].get(step)
        ]
        if old["models"] != new["models"]:
            steps.append(f"models {_words(old['models'])} -> {_words(new['models'])}")
        if old["edited"] != new["edited"]:
            steps.append("the stated edits of generated files")
        yield f"asset: {name} changed {since}: {', '.join(steps) or 'facts in the manifest'}"


def lost_manifests(release: Release, today: AssetChain, twin: Twin) -> Iterator[str]:
    """Yield one line for each manifest of a release that is gone, although its files are in use."""
    before = release.ids.get("chain", {})
    for name in sorted(before.keys() - today.content.keys()):
        path = Path(os.path.normpath(twin.root / name))
        in_use = any(file.is_relative_to(path.parent) for file in _referenced(twin))
        if in_use and path not in today.unread:
            asset = before[name]["asset"]
            yield (
                f"{path}: no manifest lists the files of the asset {asset!r} any more, and release "
                f"{release.number:04d} stands on them (expected the manifest of that release)"
            )


def _words(models: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {file}" for name, file in models.items()) or "none"


def _content(path: Path, known: Manifest, edited: list[Path], twin: Twin) -> dict[str, Any]:
    states = {}
    for name, state in known.states.items():
        states[name] = {"digest": state.digest, "made": dict(state.made)}
        if name == "source":
            copied_facts = ("supplier", "received", "origin")
            states[name] |= {key: state.facts[key] for key in copied_facts if key in state.facts}
        else:
            states[name]["files"] = dict(state.files)
    return {
        "asset": known.asset,
        "manifest": known.digest,
        "states": states,
        "models": {
            name: file
            for name, reference in twin.realizations.items()
            if reference.file.is_relative_to(path.parent)
            and known.state_of(file := reference.file.relative_to(path.parent).as_posix())
        },
        "edited": {
            file.relative_to(path.parent).as_posix(): {
                "reason": twin.edited[file].reason,
                "owner": twin.edited[file].owner,
                "content": _content_digest(file),
            }
            for file in edited
        },
    }


def _content_digest(file: Path) -> str | None:
    """Digest of a file, for XML without comments and formatting; None where it cannot be read."""
    try:
        return xml.content_sha256(file) if manifest.is_xml(file) else file_sha256(file)
    except TwinError:
        return None


def _files(path: Path, known: Manifest) -> Iterator[Path]:
    """The manifest, what it was generated from, and what was generated."""
    normalized = known.states.get("normalized")
    read = normalized.made_from if normalized is not None and known.keeps_source else ()
    generated = [name for state in manifest.STATES[1:] for name in known.files_of(state)]
    yield path
    yield from (file for name in (*read, *generated) if (file := path.parent / name).is_file())


def _problems_of_source(path: Path, changed: list[FileChange]) -> Iterator[str]:
    if changed:
        yield (
            f"{path}: the source asset has changed since intake: {_listed(changed)} "
            "(expected the files of the manifest; for new files run `pytest-twin intake`)"
        )


def _listed(changed: list[FileChange]) -> str:
    more = len(changed) - _MAX_NAMED
    listed = "; ".join(map(str, changed[:_MAX_NAMED]))
    return listed + (f"; and {more} more" if more > 0 else "")


def _problem_of_edit(path: Path, known: Manifest, change: FileChange, twin: Twin) -> str:
    command = " ".join(known.states[change.state].made.get("command", ()))
    name = os.path.relpath(path.parent / change.file, twin.root)
    return (
        f"{path}: the {change.state} asset has changed since `{command}` made it: {change} "
        f"(expected the file as it was made, or 'edited: {{{name}: {{reason: ..., owner: ...}}}}' "
        f"in {FILE_NAME})"
    )


def _problems_of_original(twin: Twin) -> Iterator[str]:
    """Changes of the asset that ``init`` copied into the twin, where it is on this machine."""
    try:
        summary = json.loads(read_bytes(twin.root / _INIT_SUMMARY, _SUMMARY_BYTES))
        copied = summary["asset"]["manifest"], summary["asset"]["copied_from"]
        here, original = (Path(str(path)) for path in copied)
    except (TwinError, ValueError, KeyError, TypeError, RecursionError):
        # Without the summary of init, the twin's own copy is what counts.
        return
    if here == original or not here.is_relative_to(twin.root) or not original.is_file():
        return
    try:
        changed = manifest.changes_of_source(original, manifest.read(original))
    except TwinError as error:
        yield str(error)
        return
    if changed:
        yield (
            f"{original}: the source asset has changed since intake: {_listed(changed)} "
            f"(this twin has a copy of the unchanged one, {here.parent}: restore the file, or set "
            "up a twin for the new one)"
        )
