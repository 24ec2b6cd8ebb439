"""Find, read and validate the golden specs of a twin."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pytest_twin.asset.manifest import is_source_folder
from pytest_twin.checks import check_of, kinds
from pytest_twin.errors import SpecError, TwinError, UnwrittenToleranceError
from pytest_twin.formats import yaml
from pytest_twin.formats.schema import validate
from pytest_twin.gate.schema import schema_of
from pytest_twin.golden import Golden, Provenance, TraceRef
from pytest_twin.twin import FILE_NAME, Twin
from pytest_twin.units import Quantity, parse_quantity

GOLDEN_FOLDER = "golden"
UNWRITTEN = "<write what the task allows, such as"
"""Beginning of a tolerance that ``init`` leaves blank; an example and ``>`` follow."""
RESERVED_FOLDERS = ("releases", "keys", ".twin")
# Folders that pytest does not search either.
_SKIPPED_FOLDERS = ("build", "dist", "node_modules", "venv")


def is_reserved(folder: Path) -> bool:
    """Whether ``folder`` contains releases, keys, caches or the source of an asset: no specs."""
    own = folder.name in RESERVED_FOLDERS and (folder.parent / FILE_NAME).is_file()
    return own or is_source_folder(folder)


def spec_paths(twin: Twin) -> tuple[Path, ...]:
    """All golden specs of ``twin``: YAML files below ``golden/`` that twin.yaml does not name."""
    return tuple(path for path in _files(twin) if path.suffix == ".yaml")


def trace_paths(twin: Twin) -> tuple[Path, ...]:
    """All traces of ``twin``: CSV files below ``golden/`` that twin.yaml does not name."""
    return tuple(path for path in _files(twin) if path.suffix == ".csv")


def _files(twin: Twin) -> Iterator[Path]:
    named = frozenset(twin.files)
    for here, folders, files in os.walk(twin.root):
        folder = Path(here)
        # A folder that contains a twin.yaml is another twin.
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".")
            and name not in _SKIPPED_FOLDERS
            and not is_reserved(folder / name)
            and not (folder / name / FILE_NAME).exists()
        )
        if contains_specs(folder, twin):
            yield from (path for name in sorted(files) if (path := folder / name) not in named)


def contains_specs(folder: Path, twin: Twin) -> bool:
    """Whether YAML files in ``folder``, at or below the root of ``twin``, are golden specs."""
    return twin.root.name == GOLDEN_FOLDER or GOLDEN_FOLDER in folder.relative_to(twin.root).parts


def golden_id(path: Path, twin: Twin) -> str:
    """Id of the golden at ``path``: the path relative to the twin's root, without suffix."""
    return os.path.relpath(path, twin.root).removesuffix(path.suffix).replace(os.sep, "/")


def load_golden(path: Path, twin: Twin) -> Golden:
    """Read and validate one spec.

    Raises:
        FormatError: not strict YAML, or beyond its bounds.
        SpecError: a field that is unknown, missing or not valid.
    """
    document = yaml.load(path)
    data = document.data
    lines = document.lines
    kind = data.get("kind") if isinstance(data, dict) else None
    if not isinstance(kind, str):
        raise SpecError(
            "no golden spec",
            path=path,
            line=lines.get("kind", 1),
            where="kind",
            value=kind,
            expected="one of " + ", ".join(kinds()),
        )
    try:
        schema = schema_of(kind)
    except SpecError as error:
        raise _located_error(error, path, lines, "kind") from error.__cause__
    validate(document, schema, path)
    tolerance, unwritten = _tolerance(data.get("tolerance", {}), kind, path, lines)
    provenance = data.get("provenance")
    trace = data.get("trace")
    return Golden(
        id=golden_id(path, twin),
        path=path,
        kind=kind,
        title=data.get("title", ""),
        realizations=_realizations(data, twin, path, lines),
        criticality=data.get("criticality", "critical"),
        target=data.get("target", {}),
        stimulus=data.get("stimulus", {}),
        tolerance=tolerance,
        expected=data.get("expected"),
        trace=None if trace is None else TraceRef(trace["file"], trace["sha256"]),
        provenance=None if provenance is None else Provenance(**provenance),
        unwritten=unwritten,
        lines=lines,
    )


def _realizations(
    data: Mapping[str, Any], twin: Twin, path: Path, lines: Mapping[str, int]
) -> tuple[str, ...]:
    """Realizations of a golden, the authoritative one first: the golden is recorded on it."""
    authority = twin.authority_of(golden_id(path, twin), data["kind"])
    declared = tuple(data.get("realizations") or (authority or twin.first_realization.name,))
    for index, name in enumerate(declared):
        if name not in twin.realizations:
            raise SpecError(
                f"twin {twin.name!r} has no such realization",
                path=path,
                line=lines.get(f"realizations.{index}", lines.get("realizations")),
                where="realizations",
                value=name,
                expected="one of " + ", ".join(twin.realizations),
            )
    if authority is None:
        return declared
    if authority not in declared:
        raise SpecError(
            f"does not run on {authority!r}, which is authoritative for it",
            path=path,
            line=lines.get("realizations"),
            where="realizations",
            value=", ".join(declared),
            expected=f"{authority!r} among them, or another rule under 'authority:' in twin.yaml",
        )
    return (authority, *(name for name in declared if name != authority))


def _tolerance(
    data: Mapping[str, str], kind: str, path: Path, lines: Mapping[str, int]
) -> tuple[dict[str, Quantity], str | None]:
    """The written tolerances, and a message about the first blank one, or None."""
    units = check_of(kind).tolerances
    tolerance = {}
    unwritten: str | None = None
    for name, text in data.items():
        where = f"tolerance.{name}"
        if text.startswith(UNWRITTEN):
            example = text.removeprefix(UNWRITTEN).strip(" >")
            unwritten = unwritten or str(
                UnwrittenToleranceError(
                    "not written yet",
                    path=path,
                    line=lines.get(where),
                    where=where,
                    expected=f"what the task allows, in {units[name]}, such as '{example}'",
                )
            )
            continue
        try:
            quantity = parse_quantity(text, (units[name],))
        except SpecError as error:
            raise _located_error(error, path, lines, where) from None
        if quantity.value < 0:
            raise SpecError(
                "the tolerance is negative",
                path=path,
                line=lines.get(where),
                where=where,
                value=text,
                expected="zero or more",
            )
        tolerance[name] = quantity
    return tolerance, unwritten


def _located_error(error: TwinError, path: Path, lines: Mapping[str, int], where: str) -> SpecError:
    return SpecError(
        error.problem,
        path=path,
        line=lines.get(where),
        where=where,
        value=error.value,
        unit=error.unit,
        expected=error.expected,
    )
