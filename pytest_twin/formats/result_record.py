"""Read what a twin needs of ``ranges.json``, ``budget.json`` and ``diagnosis.json``: its inputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.errors import FormatError
from pytest_twin.formats.record_fields import optional_table, read_record


@dataclass(frozen=True, slots=True)
class ResultRecord:
    """Result of a command that a twin uses.

    Attributes:
        id: folder and name of the file.
        path: the file.
        basis: field ``basis`` as written: content of the inputs that it used; None in a result of
            an earlier version.
        inputs: empty: such results have no digests beside their basis.
    """

    id: str
    path: Path
    basis: Mapping[str, Any] | None
    inputs: Mapping[str, str] = field(default_factory=dict)


def read_result_record(path: Path) -> ResultRecord:
    """Read the inputs of a result.

    Raises:
        PathError: missing, a link, or no regular file.
        LimitError: beyond ``limits.OBSERVATIONS``.
        FormatError: not what the command writes.
    """
    expected = f"{path.name} of pytest-twin, schema 1"
    content, _ = read_record(path, expected)
    try:
        if content["schema"] != 1:
            raise ValueError("schema")
        basis = optional_table(content.get("basis"))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise FormatError(
            f"a field is missing or unusable: {error}", path=path, expected=expected
        ) from None
    return ResultRecord(f"{path.parent.name}/{path.name}", path, basis)
