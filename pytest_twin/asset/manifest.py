"""The manifest of an asset: its states (source, normalized, realization) with digests.

Each state after the first names the state that it was made from, with its digest, and the command
and versions that made it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path, PurePosixPath
from typing import Any

from pytest_twin.dependency import canonical
from pytest_twin.errors import FormatError, PathError, TwinError
from pytest_twin.formats import atomic, xml
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.paths import decode_text, read_bytes

FILE_NAME = "manifest.json"
SOURCE_FOLDER = "source"
"""Folder of the supplier's unchanged files, next to the manifest."""
STATES = ("source", "normalized", "realization")
REPORTS = "reports"
"""Fact of a state: files that describe it, such as the change log; they carry no digest."""
_WORDS = (b'"asset"', b'"states"', b'"source"', b'"digest"', b'"files"')
"""Words of every manifest."""
_XML_SUFFIXES = (".urdf", ".xml")
_VERSIONED = ("pytest-twin", "mujoco", "trimesh", "numpy", "xacro")
"""Distributions whose versions a made state names."""
_MAX_BYTES = 64 * 2**20
"""Largest size of a manifest."""


@dataclass(frozen=True, slots=True)
class State:
    """One state of an asset.

    Attributes:
        files: path relative to the manifest, with ``/`` -> SHA-256.
        facts: further JSON fields, such as the supplier or the engine that produced the state.
    """

    files: Mapping[str, str]
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Return the SHA-256 over the paths and digests of all files, hex."""
        return bytes_sha256(canonical(dict(self.files)))

    @property
    def made(self) -> Mapping[str, Any]:
        """``command``, ``versions`` and, after the first state, ``from``; empty if not stated."""
        made = self.facts.get("made")
        return made if isinstance(made, Mapping) else {}

    @property
    def made_from(self) -> Mapping[str, str]:
        """Files of the state before that this one was made from -> SHA-256."""
        files = self.made.get("from", {}).get("files", {})
        return files if isinstance(files, Mapping) else {}


@dataclass(frozen=True, slots=True)
class Manifest:
    """States of one asset; states that it has not reached are omitted."""

    asset: str
    states: Mapping[str, State] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Return the SHA-256 over the whole content, hex."""
        return bytes_sha256(canonical(self._content()))

    @property
    def keeps_source(self) -> bool:
        """Whether the supplier's files lie next to the manifest, as ``intake`` stores them."""
        source = self.states.get("source")
        return source is not None and source.facts.get("folder") == SOURCE_FOLDER

    def state_of(self, name: str) -> str | None:
        """Return the state that contains a file; None if no state does."""
        return next((state for state in STATES if name in self.files_of(state)), None)

    def files_of(self, state: str) -> Mapping[str, str]:
        """Return file -> SHA-256 of a state; empty if the asset has not reached it."""
        return self.states[state].files if state in self.states else {}

    def _content(self) -> dict[str, Any]:
        return {
            "schema": 1,
            "asset": self.asset,
            "states": {
                name: {
                    "digest": self.states[name].digest,
                    **self.states[name].facts,
                    "files": dict(sorted(self.states[name].files.items())),
                }
                for name in STATES
                if name in self.states
            },
        }

    def to_text(self) -> str:
        """Return JSON text that depends on the content only."""
        data = {**self._content(), "digest": self.digest}
        return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def made_by(command: Iterable[str], previous: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the fact ``made`` of a state: command, versions, and what it was made from.

    Args:
        command: arguments of the command, without folders of this machine.
        previous: the state before: its name, its digest, and the files that were read.
    """
    versions = {}
    for name in _VERSIONED:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    made: dict[str, Any] = {"command": list(command), "versions": versions}
    return made if previous is None else {**made, "from": dict(previous)}


def link_to(name: str, state: State, files: Iterable[str]) -> dict[str, Any]:
    """Return the link to a state: its name and digest, and those of its files that were read."""
    return {
        "state": name,
        "digest": state.digest,
        "files": {file: state.files[file] for file in sorted(files)},
    }


def content_digests(folder: Path, files: Iterable[str]) -> dict[str, str]:
    """Return SHA-256 of the content of XML files, which formatting and comments do not change."""
    return {name: xml.content_sha256(folder / name) for name in sorted(files) if is_xml(Path(name))}


def is_xml(file: Path) -> bool:
    """Whether comments and formatting of a file have no meaning."""
    return file.suffix in _XML_SUFFIXES


def state_of(folder: Path, files: Iterable[Path], facts: Mapping[str, Any] | None = None) -> State:
    """Build the state of ``files`` below ``folder``.

    Raises:
        PathError: a file is missing or not a regular file.
    """
    return State(
        {path.relative_to(folder).as_posix(): file_sha256(path) for path in files}, facts or {}
    )


def write(path: Path, manifest: Manifest) -> None:
    """Write a manifest atomically."""
    atomic.write_text(path, manifest.to_text())


def read(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        PathError: missing, or not a regular file.
        FormatError: not a manifest, a digest that differs from that of its content, or a state
            that was made from another version of the state before it.
    """
    text = decode_text(read_bytes(path, _MAX_BYTES), path)
    try:
        data = json.loads(text, parse_constant=_refuse_constant)
        canonical(data)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"not JSON: {error}", path=path) from None
    if not isinstance(data, dict) or data.get("schema") != 1:
        raise FormatError("not a manifest of an asset", path=path, expected='"schema": 1')
    states = data.get("states")
    if not isinstance(states, dict) or not isinstance(data.get("asset"), str):
        raise FormatError("no states", path=path, where="states", expected="a table")
    read_states: dict[str, State] = {}
    for name, content in states.items():
        where = f"states.{name}"
        files = content.get("files") if isinstance(content, dict) else None
        if name not in STATES or files is None or not _are_files(files):
            raise FormatError(
                "not a state", path=path, where=where, expected="paths and their SHA-256"
            )
        facts = {key: value for key, value in content.items() if key not in ("digest", "files")}
        _check_facts(path, where, facts)
        state = State(files, facts)
        if content.get("digest") != state.digest:
            raise FormatError(
                "the digest does not follow from the files",
                path=path,
                where=f"{where}.digest",
                value=content.get("digest"),
                expected=state.digest,
            )
        read_states[name] = state
    manifest = Manifest(data["asset"], read_states)
    if data.get("digest") != manifest.digest:
        raise FormatError(
            "the manifest was changed: its digest does not follow from its content",
            path=path,
            where="digest",
            value=data.get("digest"),
            expected=f"{manifest.digest}; restore the file that pytest-twin wrote",
        )
    _check_links(path, manifest)
    return manifest


def _refuse_constant(word: str) -> None:
    raise ValueError(f"{word} is not a number of JSON")


def _check_links(path: Path, manifest: Manifest) -> None:
    for name, state in manifest.states.items():
        link = state.made.get("from")
        if link is None:
            continue
        before = manifest.states.get(link.get("state"))
        files = link.get("files")
        if (
            before is None
            or link.get("digest") != before.digest
            or not isinstance(files, dict)
            or not files.items() <= before.files.items()
        ):
            raise FormatError(
                f"the {name} state was made from another version of the {link.get('state')} state",
                path=path,
                where=f"states.{name}.made.from",
                value=link.get("digest"),
                expected=f"{None if before is None else before.digest}; restore the manifest",
            )


def _check_facts(path: Path, where: str, facts: Mapping[str, Any]) -> None:
    """Check the facts that name files; the others are for readers."""
    reports, made = facts.get(REPORTS, []), facts.get("made", {})
    link = made.get("from", {"files": {}}) if isinstance(made, dict) else None
    problems = {
        REPORTS: not (isinstance(reports, list) and all(map(_is_path_below, reports))),
        "content": not _are_files(facts.get("content", {})),
        "made": not (isinstance(link, dict) and _are_files(link.get("files"))),
    }
    for name, is_wrong in problems.items():
        if is_wrong:
            raise FormatError(
                "not paths of files of the asset",
                path=path,
                where=f"{where}.{name}",
                expected="relative paths, each with its SHA-256",
            )


def _are_files(files: Any) -> bool:
    return isinstance(files, dict) and all(
        _is_path_below(name) and isinstance(digest, str) and len(digest) == 64
        for name, digest in files.items()
    )


def _is_path_below(name: Any) -> bool:
    """Whether a text is a relative path that does not leave its folder."""
    if not isinstance(name, str) or "\0" in name:
        return False
    path = PurePosixPath(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts


@dataclass(frozen=True, slots=True)
class FileChange:
    """A file of an asset that is not as the manifest lists it.

    Attributes:
        state: the state that it belongs to.
        file: path relative to the manifest.
        problem: ``was changed``, ``was added``, or why it cannot be read, such as ``no such file``.
    """

    state: str
    file: str
    problem: str

    def __str__(self) -> str:
        separator = " " if self.problem.startswith("was ") else ": "
        return f"{self.file}{separator}{self.problem}"


def changes_of_source(path: Path, manifest: Manifest) -> list[FileChange]:
    """Return changes of the source since intake; empty if it is elsewhere."""
    if not manifest.keeps_source:
        return []
    folder, files = path.parent, manifest.states["source"].files
    changed = [
        FileChange("source", name, problem)
        for name, digest in files.items()
        if (problem := _problem_of_bytes(folder / name, digest)) is not None
    ]
    for file in sorted((folder / SOURCE_FOLDER).rglob("*")):
        name = file.relative_to(folder).as_posix()
        if (file.is_symlink() or not file.is_dir()) and name not in files:
            changed.append(FileChange("source", name, "was added"))
    return changed


def require_unchanged_source(path: Path, manifest: Manifest) -> None:
    """Check that the source of an asset is as it was at intake.

    Raises:
        PathError: it has changed.
    """
    changed = changes_of_source(path, manifest)
    if changed:
        raise PathError(
            f"the source asset has changed since intake: {changed[0]}",
            path=path,
            expected="the unchanged source, or a new `pytest-twin intake` of the changed one",
        )


def changes_of_generated(path: Path, manifest: Manifest) -> list[FileChange]:
    """Return changes of the files that ``realize`` wrote, except comments and formatting of XML."""
    changed = []
    for name in STATES[1:]:
        state = manifest.states.get(name)
        for file, digest in () if state is None else state.files.items():
            problem = _problem_of_bytes(path.parent / file, digest)
            content = state.facts.get("content", {}).get(file) if state is not None else None
            if problem is not None and not _has_content(path.parent / file, content):
                changed.append(FileChange(name, file, problem))
    return changed


def _problem_of_bytes(file: Path, digest: str) -> str | None:
    try:
        return None if file_sha256(file) == digest else "was changed"
    except TwinError as error:
        return error.problem


def _has_content(file: Path, digest: str | None) -> bool:
    try:
        return digest is not None and xml.content_sha256(file) == digest
    except TwinError:
        return False


def all_files(path: Path, manifest: Manifest) -> list[Path]:
    """Return every file of the asset that lies next to its manifest, and the manifest first."""
    states = manifest.states.items()
    listed = [
        file
        for name, state in states
        if name != "source" or manifest.keeps_source
        for file in (*state.files, *state.facts.get(REPORTS, ()))
    ]
    return [path, *(path.parent / name for name in dict.fromkeys(listed))]


def is_source_folder(folder: Path) -> bool:
    """Whether a folder holds a supplier's files as ``intake`` stored them.

    Its manifest may be damaged.
    """
    return folder.name == SOURCE_FOLDER and _is_manifest(folder.parent / FILE_NAME)


def _is_manifest(path: Path) -> bool:
    """Whether a file is a manifest of an asset, perhaps a damaged one: others use the name too."""
    try:
        text = read_bytes(path, _MAX_BYTES)
    except TwinError:
        return False
    return sum(word in text for word in _WORDS) > len(_WORDS) // 2


def find(path: Path) -> tuple[Path, Manifest] | None:
    """Find the manifest in a parent folder that lists a file in one of its states.

    Of several, the outermost: a supplier may deliver an asset that has a manifest of its own.

    Raises:
        FormatError: a manifest in a parent folder cannot be read.
    """
    nearest_first: list[tuple[Path, Manifest]] = []
    for folder in path.parents:
        candidate = folder / FILE_NAME
        if candidate.is_symlink() or not _is_manifest(candidate):
            continue
        in_source = any(is_source_folder(above) for above in (folder, *folder.parents))
        try:
            manifest = read(candidate)
        except FormatError:
            if in_source:
                # The manifest of the supplier, not ours.
                continue
            raise
        if manifest.state_of(path.relative_to(folder).as_posix()) is not None:
            nearest_first.append((candidate, manifest))
    return nearest_first[-1] if nearest_first else None
