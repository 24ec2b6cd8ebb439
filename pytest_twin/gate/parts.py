"""Every part that goldens depend on today, and every file behind them, before a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from pytest_twin.checks import Check, check_of, kinds
from pytest_twin.checks.files import find_file
from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.gate.promoted import unpromoted
from pytest_twin.gate.source import changed_sources
from pytest_twin.golden import Golden
from pytest_twin.installed import package_of, points_by_name
from pytest_twin.realization.features.cache import Features, features_of
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.staleness import Model, Stock, Surroundings, rule_problems, take_stock
from pytest_twin.twin import MODEL_FORMATS, Twin

_VERSIONED = ("simulator:", "library:")


@dataclass(frozen=True, slots=True)
class Today:
    """What there is before a run.

    Attributes:
        stock: parts, and what each golden depends on.
        files: file -> SHA-256.
        problems: what could not be found out, one line each.
        unread: realizations whose model could not be read.
    """

    stock: Stock
    files: Mapping[Path, str]
    problems: tuple[str, ...]
    unread: frozenset[str]


def look_around(
    twin: Twin, goldens: Sequence[Golden], child: Sandbox, *, fresh: bool = False
) -> Today:
    """Parts, dependencies and digests of a twin and its goldens, now.

    Args:
        twin: the twin.
        goldens: its goldens.
        child: reads models that are not known yet.
        fresh: read every model, known or not: for what is to be signed.
    """
    problems: list[str] = []
    files: dict[Path, None] = dict.fromkeys(twin.files)
    models: dict[str, Model] = {}
    for name in dict.fromkeys(name for golden in goldens for name in golden.realizations):
        try:
            features = _features(twin, name, child, fresh=fresh)
            models[name] = Model(features.parts, features.structure)
            files.update(dict.fromkeys(features.files))
        except TwinError as error:
            problems.append(str(error))
    for golden in goldens:
        files[golden.path] = None
        if golden.trace is not None:
            files[golden.path.parent / golden.trace.file] = None
    digests: dict[Path, str] = {}

    def digest(path: Path) -> str:
        if path not in digests:
            digests[path] = file_sha256(path)
        return digests[path]

    def digest_of_folder(folder: Path) -> str:
        """Of a recording that is a folder: names and digests of all its files."""
        inside = sorted(path for path in folder.rglob("*") if path.is_file())
        listed = "".join(
            f"{digest(path)} {path.relative_to(folder).as_posix()}\n" for path in inside
        )
        return bytes_sha256(listed.encode())

    def file_digest(golden: Golden | None, reference: str) -> str | None:
        try:
            if golden is None:
                return digest(Path(reference))
            found = find_file(golden, "target", reference, twin)
            return digest_of_folder(found) if found.is_dir() else digest(found)
        except TwinError:
            return None

    guarded = {golden.kind: _Guarded(check_of(golden.kind), problems) for golden in goldens}
    surroundings = Surroundings(guarded.__getitem__, installed_version, file_digest)
    problems += changed_sources(twin)
    problems += unpromoted(twin)
    problems += map(str, rule_problems(twin, goldens, models, kinds()))
    stock = take_stock(twin, goldens, models, surroundings)
    for path in files:
        try:
            digest(path)
        except TwinError as error:
            problems.append(str(error))
    wanted = {name for golden in goldens for name in golden.realizations}
    return Today(stock, digests, tuple(problems), frozenset(wanted - models.keys()))


class _Guarded:
    """A check whose ``depends`` may be anyone's code: what it raises costs its own golden only."""

    def __init__(self, check: Check, problems: list[str]) -> None:
        self.kind, self.version, self.libraries = check.kind, check.version, check.libraries
        self._check, self._problems = check, problems

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """As the check says, or an id that no part bears."""
        try:
            return frozenset(self._check.depends(golden, structure))
        except Exception as error:
            words = (
                str(error) if isinstance(error, TwinError) else f"{type(error).__name__}: {error}"
            )
            self._problems.append(f"{golden.id}: its dependencies cannot be determined: {words}")
            return (f"dependencies:{golden.id}",)


def changed_since(parts: Mapping[str, Part], files: Mapping[Path, str]) -> Iterator[str]:
    """What is not as it was: files by their bytes, installed distributions by their version."""
    for path, before in files.items():
        try:
            if file_sha256(path) != before:
                yield str(path)
        except TwinError as error:
            yield str(error)
    for ident, part in parts.items():
        if ident.startswith(_VERSIONED):
            now = installed_version(ident.partition(":")[2])
            if now != part.content["version"]:
                yield f"{ident} {part.content['version']} -> {now}"


def installed_version(distribution: str) -> str:
    """The version of an installed distribution, ``absent`` where there is none."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "absent"


def _converter(model: Path) -> dict[str, str]:
    """Version of each package that reads a model file of this suffix, where MJCF is not it."""
    points = points_by_name(MODEL_FORMATS).get(model.suffix.lower().removeprefix("."), ())
    return {point.value: package_of(point) for point in points}


def _features(twin: Twin, name: str, child: Sandbox, *, fresh: bool) -> Features:
    arguments = {"twin": str(twin.path), "realization": name}
    return features_of(
        twin,
        name,
        lambda: child.call("pytest_twin.gate.worker:features", arguments),
        {library: installed_version(library) for library in ("mujoco", "trimesh")}
        | _converter(twin.realizations[name].file),
        fresh=fresh,
    )
