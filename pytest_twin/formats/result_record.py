"""Read what a twin needs of ``ranges.json``, ``budget.json`` and ``diagnosis.json``: its inputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.formats import typed
from pytest_twin.formats.record_fields import read_record, unusable


@dataclass(frozen=True, slots=True)
class ResultRecord:
    """Result of a command that a twin uses.

    Attributes:
        id: folder and name of the file.
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
    expected = f"{path.name} of pytest-twin"
    content, _ = read_record(path, expected)
    own = {"id": f"{path.parent.name}/{path.name}", "path": path, "basis": content.get("basis")}
    try:
        return typed.build(own, ResultRecord)
    except ValueError as error:
        raise unusable(path, error, expected) from None
