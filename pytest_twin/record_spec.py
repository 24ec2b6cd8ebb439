"""Statements about a record in ``twin.yaml``: changed inputs that do not touch it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

RESULTS_WITH_MODELS = ("diagnosis.json", "identification.json")
"""Results of commands that write a fitted model into the folder ``realization`` beside them."""


@dataclass(frozen=True, slots=True)
class Unaffected:
    """Statement of a record's owner that one changed input does not touch the record.

    Attributes:
        part: the changed input, such as ``inertia:forearm``.
        digest: first digits of the SHA-256 of its changed content, so that a later change counts.
        reason, owner: why the record is still valid, and who states it.
    """

    part: str
    digest: str
    reason: str
    owner: str


def unaffected_of(data: Mapping[str, Any]) -> tuple[Unaffected, ...]:
    """Return the statements of a validated entry of ``twin.yaml``."""
    # The plugin imports this module in every project, also in one without a twin.
    from pytest_twin.formats import typed

    return typed.build(data.get("unaffected", ()), tuple[Unaffected, ...])
