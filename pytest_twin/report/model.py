"""Data classes of a report, without file access."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from pytest_twin.outcome import Outcome

Verdict = Literal["released", "holds", "refused", "passed", "failed"]


@dataclass(frozen=True, slots=True)
class Entry:
    """One golden on one realization.

    Attributes:
        outcome: its result, now or in the release that proved it.
        title: the golden's title.
        location: the spec's file and line, ``golden/fk/home.yaml:12``.
        release: number of the release that proved it, None if it ran now.
        at: time of that release, RFC 3339.
        parts: ids of the parts that it depends on.
        plot: plot as SVG, or None.
        diagnosis: link to the page of its full diagnosis, or None.
        not_run: whether it is stale and was omitted in this run; ``outcome`` states this too.
    """

    outcome: Outcome
    title: str
    location: str
    release: int | None = None
    at: str = ""
    parts: tuple[str, ...] = ()
    plot: bytes | None = None
    diagnosis: str | None = None
    not_run: bool = False


@dataclass(frozen=True, slots=True)
class Report:
    """One run of the gate on one twin.

    Attributes:
        verdict: ``released``: signed now; ``holds``: nothing new to sign; ``refused``: not
            signed; ``passed`` and ``failed``: results of runs without a release.
        headline: one sentence below the verdict.
        created: time of the run, RFC 3339, UTC.
        entries: every golden on every realization.
        refusals: reasons why nothing was signed, one line each, the most serious first.
        notes: further notes, one line each.
        release, previous: numbers of the new release and of the baseline, or None.
        expires, key_id: expiry and key of the new release, or None.
        ids: tuple of IDs of the twin.
        parts: part id -> present digest.
        environment: name -> version of the software and hardware.
    """

    twin: str
    verdict: Verdict
    headline: str
    created: str
    entries: tuple[Entry, ...]
    refusals: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    release: int | None = None
    previous: int | None = None
    expires: str | None = None
    key_id: str | None = None
    ids: Mapping[str, Any] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
