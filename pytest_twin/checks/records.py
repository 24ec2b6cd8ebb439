"""Helpers of goldens that check a calibration or identification record of the twin."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pytest_twin.checks.fields import spec_error
from pytest_twin.formats.digest import file_sha256
from pytest_twin.golden import Golden
from pytest_twin.twin import Twin

if TYPE_CHECKING:
    from pytest_twin.realization import Realization


def twin_of(golden: Golden, realization: Realization, what: str, key: str) -> Twin:
    """Return the twin that lists the record.

    Args:
        what: noun for the record, such as "an identification".
        key: key of ``twin.yaml`` that lists it.

    Raises:
        SpecError: the realization has no twin.
    """
    if realization.twin is None:
        raise spec_error(
            golden,
            "target.record",
            f"{what} golden needs a twin.yaml",
            expected=f"a twin.yaml in a folder above the golden, with {key}:",
        )
    return realization.twin


def check_unchanged(
    golden: Golden, where: str, reference: str, path: Path, inputs: Mapping[str, str], expected: str
) -> None:
    """Check that a file is unchanged since the record was made from it.

    Args:
        where: field of the spec that names the file.
        inputs: inputs of the record: file -> SHA-256, hex.

    Raises:
        SpecError: the file is not an input of the record, or has changed.
    """
    if file_sha256(path) not in inputs.values():
        raise spec_error(
            golden,
            where,
            f"not a file that {golden.target['record']} was made from",
            value=reference,
            expected=expected,
        )
