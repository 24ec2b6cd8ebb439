"""Helpers of the staleness tests: the current parts and dependencies of a twin."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pytest_twin.checks import check_of
from pytest_twin.checks.files import find_file
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.gate.distributions import installed_version
from pytest_twin.gate.specs import load_golden, spec_paths
from pytest_twin.golden import Golden
from pytest_twin.realization import load
from pytest_twin.staleness import Baseline, DependencyMap, Lookups, Model, dependency_map
from pytest_twin.twin import Twin, load_twin


def dependency_map_of(root: Path, versions: Mapping[str, str] | None = None) -> DependencyMap:
    """Parts and dependencies of the twin in a folder, as the gate computes them."""
    twin = load_twin(root / "twin.yaml")
    goldens = [load_golden(path, twin) for path in spec_paths(twin)]
    models = {}
    for name, ref in twin.realizations.items():
        realization = load(ref.file, twin=twin, name=name)
        models[name] = Model(realization.parts, realization.structure)
    return dependency_map(twin, goldens, models, lookups(twin, versions or {}))


def lookups(twin: Twin, versions: Mapping[str, str]) -> Lookups:
    def file_digest(golden: Golden | None, reference: str) -> str | None:
        try:
            path = Path(reference) if golden is None else find_file(golden, "", reference, twin)
            return file_sha256(path)
        except TwinError:
            return None

    def version(name: str) -> str:
        return versions.get(name, installed_version(name))

    return Lookups(check_of, version, file_digest)


def proven(dependencies: DependencyMap, number: int = 1) -> Baseline:
    """A release in which all goldens of the dependency map have passed."""
    return Baseline(
        number,
        dependencies.parts,
        dict.fromkeys(dependencies.depends_on, True),
        dependencies.depends_on,
    )
