"""What goldens share that re-check a record of the twin: a calibration or an identification."""

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
    """The twin that lists the record.

    Args:
        what: the record, as "an identification".
        key: of ``twin.yaml``, under which it is listed.

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
    """Check that a record was made from a file as it is now.

    Args:
        where: field of the spec that names the file.
        reference: what stands there.
        path: the file.
        inputs: of the record, file -> SHA-256, hex.
        expected: the files that would do.

    Raises:
        SpecError: it was made from other files, or the file has changed.
    """
    if file_sha256(path) not in inputs.values():
        raise spec_error(
            golden,
            where,
            f"not a file that {golden.target['record']} was made from",
            value=reference,
            expected=expected,
        )
