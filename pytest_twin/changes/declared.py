"""What the metadata of recordings declare as different: it is applied first, and no change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from pytest_twin.identification.roles import NO_PAYLOAD
from pytest_twin.realization import Realization

_NONE = "none"


class Declared(Protocol):
    """A recording with its metadata."""

    @property
    def metadata(self) -> Mapping[str, str]:
        """The record ``trial``."""


def declared_differences(
    realization: Realization, before: Sequence[Declared], new: Sequence[Declared]
) -> list[dict[str, Any]]:
    """Payload, controller, tool and temperature of earlier and new recordings where they differ.

    Returns:
        ``what``; ``before`` and ``now``: the declared values; ``in_model``: whether the twin states
        what they are, so that the model of each recording has its own.
    """
    twin = realization.twin
    stated: Mapping[str, Mapping[str, Any]] = (
        {} if twin is None else {"payload": twin.payloads, "controller": twin.controllers}
    )
    out = []
    for what in ("payload", "controller", "tool", "temperature"):
        old, now = (sorted({_value(what, r) for r in records}) for records in (before, new))
        if old != now:
            known = stated.get(what, {})
            in_model = all(value == _NONE or value in known for value in (*old, *now))
            out.append({"what": what, "before": old, "now": now, "in_model": in_model})
    return out


def _value(what: str, recording: Declared) -> str:
    value = recording.metadata.get(what, "")
    return _NONE if value.lower() in {"", *NO_PAYLOAD} else value
