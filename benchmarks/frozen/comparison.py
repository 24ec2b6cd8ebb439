"""Compare two files of answers row by row and by family, with one definition of "not worse".

An answer is not worse if

- its first name is right, or the old one was wrong too;
- its held-out error is at most 1 % larger than the old one. It is the RMS over joints in noise
  floors of the old answer, and an error below the floor counts as the floor. If the two answers
  measured it on other samples (the error of the nominal model differs by more than 1 %), the
  replayed held-out recordings of the written models decide;
- it has no more false names of a confidence of 0.9 or above;
- it took at most 10 % more simulations of all recordings;
- the command ended, or the old one did not either.

A row whose inputs differ, or that one of the files lacks, is not compared.
"""

from __future__ import annotations

import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "concealed"))

from family_score import SURE, intervals, is_effect, removed, sure
from family_score import Answer as Scored

from frozen.answer import Answer

LARGER = 1.01
"""Largest ratio of held-out errors, new to old."""
MORE_SIMULATIONS = 1.1
"""Largest ratio of the numbers of simulations, new to old: their last fit may take a step more."""


@dataclass(frozen=True)
class Judged:
    """An answer, judged by the truth of its row.

    Attributes:
        answer: the answer.
        truth: the truth; without ``effects`` if nobody knows it.
    """

    answer: Answer
    truth: Mapping[str, Any]

    @property
    def scored(self) -> Scored:
        """The same for the scores of blind cases."""
        truth = {"background": [], "effects": [], **self.truth}
        return Scored(truth, {}, self.answer if "findings" in self.answer else None)

    @property
    def has_ended(self) -> bool:
        """Whether the command wrote a result."""
        return "verdict" in self.answer

    @property
    def first_is_right(self) -> bool | None:
        """Whether the first name is the largest hidden effect, or nothing where none is hidden.

        None where nobody knows, and where no hidden effect changes the readings.
        """
        if "effects" not in self.truth or "stages" in self.answer:
            return None
        scored = self.scored
        if scored.hidden:
            # Of equally large effects either may be first.
            largest = scored.hidden[0]["visibility"]
            first = scored.findings[:1]
            return any(
                is_effect(f, e) for f in first for e in scored.hidden if e["visibility"] == largest
            )
        return None if self.truth["effects"] else not scored.findings

    @property
    def right_at_sure(self) -> int:
        """Number of names at 0.9 and above that are right or background."""
        if "effects" not in self.truth:
            return 0
        return len(sure(self.scored, "right")) + len(sure(self.scored, "background"))

    @property
    def false_at_sure(self) -> int:
        """Number of false names at 0.9 and above."""
        return len(sure(self.scored, "false")) if "effects" in self.truth else 0

    @property
    def is_alone(self) -> bool | None:
        """For one hidden law: its name at 0.9, or equal shares with laws that predict the same.

        No other name may be there. None for other families.
        """
        if self.truth.get("family") != "one_law":
            return None
        (hidden,) = self.truth["effects"]
        same = {(hidden["effect"], hidden["joint"]), *map(tuple, hidden["equivalents"])}
        if len(self.scored.findings) != 1:
            return False
        (found,) = self.scored.findings
        shares: dict[tuple[str, str | None], float] = defaultdict(float)
        for one in (found, *found["alternatives"]):
            shares[one["effect"], one.get("joint")] += one["confidence"]
        true = shares[hidden["effect"], hidden["joint"]]
        of_same = [share for name, share in shares.items() if name in same]
        return bool(
            (found["effect"], found["joint"]) in same
            and sum(of_same) >= SURE
            and true >= 0.5 * max(of_same)
        )


def worse(old: Judged, new: Judged) -> list[str]:
    """Return in what the new answer is worse, in words; empty if it is not worse."""
    if not new.has_ended:
        return [f"no result (exit status {new.answer['status']})"] if old.has_ended else []
    if not old.has_ended:
        return []
    out = []
    if old.first_is_right and not new.first_is_right:
        out.append("the first name is not right any more")
    if new.false_at_sure > old.false_at_sure:
        out.append(f"{new.false_at_sure} false names at {SURE:g} instead of {old.false_at_sure}")
    error = error_ratio(old.answer, new.answer)
    if error is not None and error > LARGER:
        out.append(f"held-out error times {error:.3g}")
    taken = [answer.answer.get("simulations") for answer in (old, new)]
    if all(taken) and taken[1] > MORE_SIMULATIONS * taken[0]:
        out.append(f"{taken[1]:.0f} simulations instead of {taken[0]:.0f}")
    return out


def error_ratio(old: Answer, new: Answer) -> float | None:
    """Return the ratio of held-out errors, new to old; None if they cannot be compared."""
    both = [
        (old["held_out"][j], new["held_out"][j]) for j in old["held_out"] if j in new["held_out"]
    ]
    if both and "effort_relative" in both[0][0]:
        pairs = [(a["effort_relative"], b["effort_relative"]) for a, b in both]
        return _ratio([(a, b) for a, b in pairs if a and b])
    known = [(a, b) for a, b in both if None not in (*a.values(), *b.values())]
    if len(known) == len(old["held_out"]) and all(
        math.isclose(a["rms_before"], b["rms_before"], rel_tol=LARGER - 1.0) for a, b in known
    ):
        return _ratio(
            [
                (max(a["rms_after"] / a["floor"], 1.0), max(b["rms_after"] / a["floor"], 1.0))
                for a, b in known
            ]
        )
    floors = {joint: error["floor"] for joint, error in old["held_out"].items()}
    pairs = []
    for recording, errors in old.get("replayed", {}).items():
        again = new.get("replayed", {}).get(recording)
        if again is None:
            return math.inf
        pairs += [
            (max(errors[j][0] / floor, 1.0), max(again[j][0] / floor, 1.0))
            for j, floor in floors.items() if j in errors and j in again and floor
        ]  # fmt: skip
    return _ratio(pairs)


def _ratio(pairs: Sequence[tuple[float, float]]) -> float | None:
    if not pairs:
        return None
    old, new = (math.sqrt(sum(p[k] ** 2 for p in pairs) / len(pairs)) for k in (0, 1))
    return new / old if old else None


def table(rows: Sequence[tuple[str, Judged, Judged | None]]) -> Iterator[str]:
    """Yield a line for each row, then figures pooled by family; without new answers the old."""
    for name, old, new in rows:
        words = _described(old) if new is None else f"{_described(old)} -> {_described(new)}"
        verdict = "" if new is None else "; ".join(worse(old, new)) or "not worse"
        yield f"{name}: {words}{f': {verdict}' if verdict else ''}"
    families: dict[str, list[tuple[Judged, Judged | None]]] = defaultdict(list)
    for name, old, new in rows:
        problem, _, limit = name.rpartition("@")
        families[f"{problem.partition('/')[0]}, limit {limit}"].append((old, new))
    yield ""
    yield "| family | figure | old | new |"
    yield "|---|---|---|---|"
    for family, answers in sorted(families.items()):
        columns = [[old for old, _ in answers], [new for _, new in answers if new is not None]]
        for figure, values in zip(FIGURES, zip(*map(_pooled, columns), strict=True), strict=True):
            if set(values) <= {"0 of 0", "none"}:
                continue
            yield f"| {family} | {figure} | {values[0]} | {values[1]} |"


FIGURES = (
    "rows with a result", "first name right", "one law, alone or in equal shares",
    "right names at 0.9 and above", "false names at 0.9 and above",
    "explainable held-out squared error removed, median", "95 % intervals that hold the truth",
    "simulations, median", "processor time, median",
)  # fmt: skip


def _pooled(column: Sequence[Judged]) -> list[str]:
    firsts = [j.first_is_right for j in column if j.first_is_right is not None]
    alone = [j.is_alone for j in column if j.is_alone is not None]
    inside = [value for j in column for value in intervals(j.scored)]
    gone = [share for j in column if (share := removed(j.scored)) is not None]
    simulations = [j.answer["simulations"] for j in column if j.answer.get("simulations")]
    seconds = [j.answer["processor_seconds"] for j in column]
    at_sure = sum(j.right_at_sure + j.false_at_sure for j in column)
    return [
        f"{sum(j.has_ended for j in column)} of {len(column)}",
        f"{sum(firsts)} of {len(firsts)}",
        f"{sum(alone)} of {len(alone)}",
        f"{sum(j.right_at_sure for j in column)} of {at_sure}",
        f"{sum(j.false_at_sure for j in column)} of {at_sure}",
        f"{100.0 * np.median(gone):.1f} % of {len(gone)}" if gone else "none",
        f"{sum(inside)} of {len(inside)}",
        f"{np.median(simulations):.0f}" if simulations else "none",
        f"{np.median(seconds):.0f} s" if seconds else "none",
    ]


def _described(judged: Judged) -> str:
    """Return findings, held-out error and cost of an answer in a few words."""
    answer = judged.answer
    if not judged.has_ended:
        return f"no result ({answer['status']})"
    names = ", ".join(
        f"{f['effect']} {f['joint'] or ''}".strip() + f" {f['confidence']:.2f}"
        for f in judged.scored.findings
    )
    if "stages" in answer:
        errors = " ".join(
            f"{100.0 * e['effort_relative']:.1f}"
            for e in answer["held_out"].values() if e.get("effort_relative") is not None
        )  # fmt: skip
        return f"{answer['verdict']}, effort errors {errors} %"
    floors = [
        e["rms_after"] / e["floor"] for e in answer["held_out"].values()
        if e["rms_after"] is not None and e["floor"]
    ]  # fmt: skip
    right = {True: "right", False: "wrong", None: "not judged"}[judged.first_is_right]
    worst = f"{max(floors):.2g} floors" if floors else "no error known"
    return f"{names or 'nothing'} ({right}), {answer['verdict']}, {worst}"
