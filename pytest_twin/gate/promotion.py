"""Check that a shadow run has promoted the residual and the online update of a twin."""

from __future__ import annotations

import json
from collections.abc import Iterator

from pytest_twin.adaptation_spec import ResidualSpec, digest_of
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.paths import read_bytes
from pytest_twin.twin import Twin

_RECORD_BYTES = 16 * 2**20
"""Largest size of the record of a shadow run."""


def unpromoted_lines(twin: Twin) -> Iterator[str]:
    """Yield one line for each residual or update of a twin that no shadow run has promoted."""
    for key, spec in (("residual", twin.residual), ("update", twin.update)):
        if spec is None:
            continue
        path = twin.shadow_record(spec.id)
        expected = (
            f"(expected a promoted {key}: "
            "pytest-twin shadow RELEASE CANDIDATE RECORDING... --promote)"
        )
        try:
            record = json.loads(read_bytes(path, _RECORD_BYTES))
            file = spec.file if isinstance(spec, ResidualSpec) else None
            current = digest_of(spec, None if file is None else file_sha256(file))
        except (TwinError, ValueError, RecursionError) as error:
            yield f"{path}: {key} {spec.id!r}: no valid record of a shadow run: {error} {expected}"
            continue
        if not isinstance(record, dict) or record.get("verdict") != "better":
            yield f"{path}: {key} {spec.id!r}: the shadow run did not find it better {expected}"
        elif record.get("digest") != current:
            yield f"{path}: {key} {spec.id!r} has changed since its shadow run {expected}"
