"""What a report tells: plain facts, no files."""

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
        outcome: what came of it, now or when it was proven.
        title: the golden's title.
        location: the spec's file and line, ``golden/fk/home.yaml:12``.
        release: number of the release that proved it, None where it ran now.
        at: RFC 3339, when that release was made.
        parts: ids of what it depends on.
        plot: SVG, None where there is none.
        diagnosis: reference to the page of its full diagnosis, None where there is none.
        not_run: whether it is stale and this run left it out; ``outcome`` then says so.
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
        twin: its name.
        verdict: ``released`` signed now, ``holds`` nothing new to sign, ``refused`` not signed,
            ``passed`` and ``failed`` runs that were not to be signed.
        headline: one sentence under the verdict.
        created: RFC 3339, UTC.
        entries: every golden on every realization.
        refusals: why nothing was signed, one line each, the most serious first.
        notes: what else to say.
        release, previous: numbers of the release written now and of the baseline.
        expires, key_id: of the release written now.
        ids: the tuple of IDs.
        parts: part id -> digest today.
        environment: what it ran on.
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
