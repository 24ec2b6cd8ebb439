"""Marks of doubtful samples, as JSON data and as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pytest_twin.trial.trial import Trial


def marks_to_json(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Marks of the parts of a recording; times in s from the first state of the first part."""
    return [
        {
            "kind": mark.kind,
            "topic": mark.topic,
            "joint": mark.joint,
            "start": trial.offset + mark.start,
            "end": trial.offset + mark.end,
            "text": mark.text,
        }
        for trial in trials
        for mark in trial.marks
    ]


def describe_marks(marks: Iterable[Mapping[str, Any]]) -> list[str]:
    """Lines about doubtful samples: the first stretch of each kind; each damage of the file.

    Args:
        marks: result of :func:`marks_to_json`.
    """
    by_kind: dict[str, list[Mapping[str, Any]]] = {}
    for mark in marks:
        by_kind.setdefault(mark["kind"], []).append(mark)
    damages = dict.fromkeys(mark["text"] for mark in by_kind.pop("damage", ()))
    lines = [f"damaged: {text}" for text in damages]
    for kind, same in by_kind.items():
        first = same[0]
        where = first["joint"] or first["topic"]
        count = "" if len(same) == 1 else f"; {len(same)} such stretches"
        lines.append(
            f"doubtful ({kind}), kept: {where} {first['text']} at {first['start']:.4g} s{count}"
        )
    return lines
