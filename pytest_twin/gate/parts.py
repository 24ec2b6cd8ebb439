"""Collect the parts and files that goldens depend on, before a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pytest_twin.checks import Check, check_of, kinds
from pytest_twin.checks.files import find_file
from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import bytes_sha256, file_sha256
from pytest_twin.formats.trial_metadata import file_beside
from pytest_twin.gate.asset_chain import AssetChain, chain_of
from pytest_twin.gate.distributions import installed_version
from pytest_twin.gate.promotion import unpromoted_lines
from pytest_twin.golden import Golden
from pytest_twin.installed import entry_points_by_name, package_of
from pytest_twin.realization.features.cache import Features, features_of
from pytest_twin.realization.sandbox import Sandbox
from pytest_twin.records.files import file_digests, source_reference
from pytest_twin.records.state import RecordState, record_states, unknown_statements, with_records
from pytest_twin.staleness import DependencyMap, Lookups, Model, dependency_map, rule_problems
from pytest_twin.twin import MODEL_FORMATS, RealizationRef, Twin

_VERSIONED = ("simulator:", "library:")


@dataclass(frozen=True, slots=True)
class CollectedDependencies:
    """Dependencies of a twin's goldens before a run.

    Attributes:
        dependencies: parts, and the parts that each golden depends on.
        files: file -> SHA-256.
        problems: errors while the dependencies were collected, one line each.
        unread: realizations whose model could not be read.
        chain: from the supplier's archive to the models.
        records: records in use, with the changes of their inputs.
    """

    dependencies: DependencyMap
    files: Mapping[Path, str]
    problems: tuple[str, ...]
    unread: frozenset[str]
    chain: AssetChain
    records: tuple[RecordState, ...] = ()


def collect_dependencies(
    twin: Twin, goldens: Sequence[Golden], child: Sandbox, *, fresh: bool = False
) -> CollectedDependencies:
    """Collect parts, dependencies and file digests of a twin and its goldens.

    Args:
        child: process that reads the models that are not in the cache.
        fresh: whether to read all models without the cache, for a release.
    """
    problems: list[str] = []
    files: dict[Path, None] = dict.fromkeys(twin.files)
    models: dict[str, Model] = {}
    for name in dict.fromkeys(name for golden in goldens for name in golden.realizations):
        try:
            features = _features(twin, twin.realizations[name], child, fresh=fresh)
            models[name] = Model(features.parts, features.structure, features.replaced)
            files.update(dict.fromkeys(features.files))
        except TwinError as error:
            problems.append(str(error))
    for golden in goldens:
        files[golden.path] = None
        if golden.trace is not None:
            files[golden.path.parent / golden.trace.file] = None
    chain = chain_of(twin)
    files.update(dict.fromkeys(chain.files))
    digests: dict[Path, str] = {}

    def digest(path: Path) -> str:
        if path not in digests:
            digests[path] = file_sha256(path)
        return digests[path]

    def digest_of_folder(folder: Path) -> str:
        """Digest of a recording that is a folder: of the names and digests of all its files."""
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
            metadata = file_beside(found)
            if metadata is not None:
                return bytes_sha256(f"{digest(found)} {digest(metadata)}".encode())
            return digest_of_folder(found) if found.is_dir() else digest(found)
        except TwinError:
            return None

    checks = {
        golden.kind: _CheckWithReportedErrors(check_of(golden.kind), problems) for golden in goldens
    }
    lookups = Lookups(checks.__getitem__, installed_version, file_digest)
    problems += chain.problems
    problems += unpromoted_lines(twin)
    problems += map(str, rule_problems(twin, goldens, models, kinds()))
    dependencies = dependency_map(twin, goldens, models, lookups)
    try:
        records = states_of_records(twin, child, fresh=fresh)
    except TwinError as error:
        records = ()
        problems.append(str(error))
    dependencies = with_records(dependencies, records, models)
    problems += map(str, unknown_statements(records, twin))
    for path in files:
        try:
            digest(path)
        except TwinError as error:
            problems.append(str(error))
    wanted = {name for golden in goldens for name in golden.realizations}
    return CollectedDependencies(
        dependencies,
        digests,
        tuple(problems),
        frozenset(wanted - models.keys()),
        chain,
        records,
    )


def states_of_records(
    twin: Twin, child: Sandbox, *, fresh: bool = False
) -> tuple[RecordState, ...]:
    """Compare the inputs of each record of a twin with the present ones.

    Args:
        child: process that reads the models that are not in the cache.
        fresh: whether to read all models without the cache, for a release.

    Raises:
        TwinError: a record or a model cannot be read.
    """
    read: dict[str | Path, Model] = {}

    def source_of(model: str | Path) -> Model:
        if model not in read:
            reference = source_reference(twin, model)
            features = _features(
                twin, reference, child, fresh=fresh, is_realization=isinstance(model, str)
            )
            read[model] = Model({**features.parts, **features.replaced}, features.structure)
        return read[model]

    return record_states(twin, source_of, file_digests(twin))


class _CheckWithReportedErrors:
    """A check whose errors in ``depends`` are reported and make only its own golden stale.

    The check may come from another package.
    """

    def __init__(self, check: Check, problems: list[str]) -> None:
        self.kind, self.version, self.libraries = check.kind, check.version, check.libraries
        self._check, self._problems = check, problems

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Ids of the check, or after an error the id of a part that does not exist."""
        try:
            return frozenset(self._check.depends(golden, structure))
        except Exception as error:
            words = (
                str(error) if isinstance(error, TwinError) else f"{type(error).__name__}: {error}"
            )
            self._problems.append(f"{golden.id}: its dependencies cannot be determined: {words}")
            return (f"dependencies:{golden.id}",)


def changed_since(parts: Mapping[str, Part], files: Mapping[Path, str]) -> Iterator[str]:
    """Yield a line for each file or installed distribution that has changed since ``parts``."""
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


def _converter(model: Path) -> dict[str, str]:
    """Entry point -> package and version, of the packages that read models of this suffix."""
    points = entry_points_by_name(MODEL_FORMATS).get(model.suffix.lower().removeprefix("."), ())
    return {point.value: package_of(point) for point in points}


def _features(
    twin: Twin,
    reference: RealizationRef,
    child: Sandbox,
    *,
    fresh: bool = False,
    is_realization: bool = True,
) -> Features:
    def read() -> object:
        path = str(twin.path)
        if is_realization:
            arguments = {"twin": path, "realization": reference.name}
            return child.call("pytest_twin.gate.worker:features", arguments)
        arguments = {"twin": path, "name": reference.name, "model": str(reference.file)}
        return child.call("pytest_twin.gate.worker:source_features", arguments)

    return features_of(
        twin,
        reference,
        read,
        {library: installed_version(library) for library in ("mujoco", "trimesh")}
        | _converter(reference.file),
        fresh=fresh,
    )
