"""Sources of the values that a file does not state; one source often resolves several findings."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any


@dataclass(frozen=True, slots=True)
class Source:
    """One document, recording or test that resolves findings.

    Attributes:
        name: name in the JSON report.
        what: description, with the values to look for.
        next_step: what to do with these values.
        codes: findings that it resolves; ``*.what`` applies to every layer.
    """

    name: str
    what: str
    next_step: str
    codes: Sequence[str]


@cache
def sources() -> tuple[Source, ...]:
    """Return every source of ``sources.toml``."""
    table = tomllib.loads(resources.files(__package__).joinpath("sources.toml").read_text("utf-8"))
    return tuple(Source(name, **fields) for name, fields in table.items())


@cache
def _by_code() -> Mapping[str, Source]:
    return {code: source for source in sources() for code in source.codes}


def source_of(code: str) -> Source | None:
    """Return the source that resolves findings of a code, or None."""
    table = _by_code()
    return table.get(code) or table.get(f"*.{code.partition('.')[2]}")


def findings_by_source(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the findings of ``rows`` that each source resolves, most findings first.

    Only findings of severity ``unknown`` count.
    """
    codes: dict[str, Counter[str]] = {}
    for row in rows:
        source = source_of(str(row["code"]))
        if row["severity"] == "unknown" and source is not None:
            codes.setdefault(source.name, Counter())[str(row["code"])] += 1
    found = [
        {
            "name": source.name,
            "what": source.what,
            "next_step": source.next_step,
            "count": codes[source.name].total(),
            "codes": dict(codes[source.name]),
        }
        for source in sources()
        if source.name in codes
    ]
    return sorted(found, key=lambda one: -int(one["count"]))
