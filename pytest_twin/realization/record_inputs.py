"""Inputs of records: the model before any record replaces its values, and the basis of a record."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part
from pytest_twin.errors import PathError
from pytest_twin.formats.content_digest import content_digest
from pytest_twin.realization.loading import load
from pytest_twin.realization.model import Realization
from pytest_twin.records.basis import Basis, Uses, input_parts
from pytest_twin.records.files import file_digests, source_reference
from pytest_twin.records.state import RecordState, record_states, stale_lines
from pytest_twin.staleness import Model
from pytest_twin.twin import RealizationRef, Twin, load_twin


def unfitted(realization: Realization) -> Realization:
    """Return the model without the values that records of its twin replace.

    Raises:
        TwinError: the model's files cannot be read any more.
    """
    twin = realization.twin
    if twin is None:
        return realization
    base = None if twin.calibration is None else twin.calibration.transform_world_to_base
    if twin.fit is None and base is None:
        return realization
    reference = RealizationRef(realization.name, realization.path, realization.simulator)
    return load_unfitted(twin, reference)


def load_unfitted(twin: Twin, reference: RealizationRef) -> Realization:
    """Load a model of a twin without the values that records replace.

    Raises:
        TwinError: it does not load.
    """

    def loaded(*, shapes: bool) -> Realization:
        return load(
            reference.file,
            twin=replace(twin, fit=None, fit_tables=(), fits=(), calibration=None),
            name=reference.name,
            # The fit may state a valid inertia in place of an invalid one.
            accept_invalid_inertia=True,
            shapes=shapes,
            simulator=reference.simulator,
        )

    try:
        return loaded(shapes=True)
    except PathError:
        # Meshes are missing: an estimation that needs no shapes was made without them.
        return loaded(shapes=False)


def replaced_parts(realization: Realization) -> dict[str, Part]:
    """Parts with the model's own values, where its twin replaces them.

    Raises:
        TwinError: the model's files cannot be read any more.
    """
    source = unfitted(realization)
    return {
        ident: part
        for ident, part in source.parts.items()
        if ident not in realization.parts or realization.parts[ident].digest != part.digest
    }


def model_of(realization: Realization) -> Model:
    """Parts and structure of a realization."""
    return Model(realization.parts, realization.structure)


def basis_json(
    source: Realization | None,
    uses: Uses,
    twin: Twin | None,
    folder: Path,
    files: Mapping[str, Path],
    *,
    has_twin: bool,
) -> dict[str, Any]:
    """Return ``basis`` of a new record: the present content of the inputs that it uses.

    Args:
        source: the model, from :func:`unfitted`; None if the estimation uses none.
        uses: parts that the estimation uses.
        twin: the twin with only the records that the estimation was given.
        files: name -> file of recordings and observations.
        has_twin: whether a ``twin.yaml`` was given, not the model alone.
    """
    folder = folder.resolve()
    parts = {} if source is None else input_parts(uses, model_of(source), twin, has_twin=has_twin)
    return Basis(
        "" if source is None else os.path.relpath(source.path, folder),
        has_twin,
        uses,
        parts,
        {
            name: (os.path.relpath(path.resolve(), folder), content_digest(path))
            for name, path in files.items()
            if path.is_file()
        },
    ).to_json()


def result_basis(realization: Realization, section: str, folder: Path) -> dict[str, Any]:
    """Return ``basis`` of a result that is computed from all records of a twin.

    Args:
        realization: the model with its twin.
        section: section of ``twin.yaml`` that states the task: ``ranges`` or ``budget``.
    """
    twin = realization.twin
    assert twin is not None
    uses = Uses(
        everything=True,
        controllers=tuple(twin.controllers),
        payloads=tuple(twin.payloads),
        section=section,
    )
    recordings = (
        (*twin.ranges.final, *twin.ranges.held_out)
        if section == "ranges"
        else twin.budget.recordings
    )
    records = (
        *(entry.record.path for entry in twin.fits),
        *(entry.record.path for entry in twin.calibrations),
        *(group.record.path for group in twin.ranges.trials),
    )
    files = {
        os.path.relpath(path, twin.root): path for path in dict.fromkeys((*recordings, *records))
    }
    return basis_json(unfitted(realization), uses, twin, folder, files, has_twin=True)


def refuse_stale_records(twin: Twin) -> None:
    """Refuse a twin one of whose estimates is stale.

    Raises:
        SpecError: the first stale record.
    """
    for state in states_of_records(twin):
        if state.touching and state.kind not in ("randomize", "budget"):
            raise state.as_error(twin)


def states_of_records(twin: Twin) -> tuple[RecordState, ...]:
    """Compare the inputs of each record of a twin with the present ones; models are loaded.

    Raises:
        TwinError: a record or a model cannot be read.
    """

    def source_of(model: str | Path) -> Model:
        return model_of(load_unfitted(twin, source_reference(twin, model)))

    return record_states(twin, source_of, file_digests(twin))


def with_stale_records(realization: Realization) -> Realization:
    """Add a note for each stale record of the twin to a realization, and return it.

    Raises:
        TwinError: a record or a model cannot be read.
    """
    twin = realization.twin
    if twin is not None and twin.has_records:
        source = realization.source
        notes = stale_lines(states_of_records(twin), twin)
        realization.source = replace(source, notes=(*source.notes, *notes))
    return realization


def stale_record_lines(twin: str) -> list[str]:
    """Return one line for each stale record of the twin in a ``twin.yaml``, in the child process.

    Raises:
        TwinError: the twin, a record or a model cannot be read.
    """
    loaded = load_twin(Path(twin))
    return list(stale_lines(states_of_records(loaded), loaded))
