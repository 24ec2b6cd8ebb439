"""Roles of recordings in a diagnosis: to fit, to validate, to test.

Effects are chosen with the fit and validation recordings. Their parameters are then fitted to both.
The test recordings are opened once, after that: every reported error and gain is measured on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.trial import Trial

_FEWEST = 4
"""Recordings to fit from which some validate. Of three, each often has a motion of its own (steps,
slow reversals, a multisine): to fit without one of them would hide what only that one shows."""
_LEAST_SHARE, _MOST_SHARE = 0.2, 1.0 / 3.0
"""Share of the recorded time that validates: the usual fifth to third (Hastie, Tibshirani, Friedman
2009, sec. 7.2)."""
_QUANTILES = (0.02, 0.98)
"""Ends of the range of a motion; what lies outside may be an outlier."""
_CONDITIONS = ("controller", "payload", "temperature")


@dataclass(frozen=True, slots=True)
class Roles:
    """Trials by role.

    Attributes:
        fit: parameters are fitted to these while effects are chosen.
        validation: they decide about effects and are not fitted meanwhile; empty where too few
            recordings are there to fit.
        test: they are opened after the effects are chosen and fitted; may be empty.
        note: how the validation recordings were chosen, one line.
        read: all trials as they were read, with their notes.
    """

    fit: tuple[Trial, ...]
    validation: tuple[Trial, ...]
    test: tuple[Trial, ...]
    note: str
    read: TrialSet

    @property
    def of_search(self) -> TrialSet:
        """What the choice of effects may read: nothing of the test recordings."""
        return replace(self.read, fit=self.fit, held_out=self.validation)


def roles_of(read: TrialSet) -> Roles:
    """Take validation recordings out of those to fit.

    A fifth to a third of the recorded time validates, by whole recordings. Every condition
    (controller, payload, temperature) keeps recordings to fit, and those validate whose range of
    positions and speeds the others cover best. The order of the recordings does not matter. Below
    four recordings all are fitted, and effects are accepted by an information criterion alone.
    """
    paths = sorted(dict.fromkeys(t.path for t in read.fit), key=str)
    if len(paths) < _FEWEST:
        return Roles(read.fit, (), read.held_out, _of_few(len(paths)), read)
    chosen = _chosen(paths, read.fit)
    if not chosen:
        return Roles(read.fit, (), read.held_out, _of_different(len(paths)), read)
    names = ", ".join(p.name for p in paths if p in chosen)
    return Roles(
        tuple(t for t in read.fit if t.path not in chosen),
        tuple(t for t in read.fit if t.path in chosen),
        read.held_out,
        f"validation (chosen automatically): {names}; effects are chosen with the fit and "
        "validation recordings, and their parameters are fitted to both",
        read,
    )


def _of_few(count: int) -> str:
    which = "one recording" if count == 1 else f"{count} recordings"
    return (
        f"{which} to fit, too few to set one aside for validation: effects are accepted by an "
        f"information criterion on what is fitted; from {_FEWEST} on some validate"
    )


def _of_different(count: int) -> str:
    return (
        f"{count} recordings to fit, too few to validate under every controller, payload and "
        "temperature: none is set aside for validation; effects are accepted by an information "
        "criterion"
    )


def _chosen(paths: Sequence[Path], trials: Sequence[Trial]) -> set[Path]:
    """Recordings that validate."""
    of = {p: [t for t in trials if t.path == p] for p in paths}
    seconds = {p: sum(t.duration for t in of[p]) for p in paths}
    kind = {p: tuple(of[p][0].metadata.get(c) for c in _CONDITIONS) for p in paths}
    ranges = {p: _ranges(of[p]) for p in paths}
    whole = sum(seconds.values())
    chosen: set[Path] = set()

    def taken(p: Path) -> float:
        """Share of the time of a recording's condition that validates already."""
        alike = [q for q in paths if kind[q] == kind[p]]
        return sum(seconds[q] for q in alike if q in chosen) / sum(seconds[q] for q in alike)

    def covers_all() -> bool:
        return {kind[p] for p in chosen} == set(kind.values())

    while sum(seconds[p] for p in chosen) < _LEAST_SHARE * whole or not covers_all():
        left = [p for p in paths if p not in chosen]
        spare = [
            p for p in left
            if sum(kind[q] == kind[p] for q in left) > 1
            and sum(seconds[q] for q in (*chosen, p)) <= _MOST_SHARE * whole
        ]  # fmt: skip
        if not spare:
            break
        chosen.add(min(spare, key=lambda p: (taken(p), _uncovered(p, left, ranges), str(p))))
    # What shows under one condition alone (cold, one payload) has to be validated there.
    return chosen if covers_all() else set()


def _ranges(trials: Sequence[Trial]) -> dict[str, FloatArray]:
    """Joint -> (2, 2) lower and upper end of positions and of speeds."""
    found = {}
    for j in trials[0].joints:
        ends = []
        for t in trials:
            position = t.position[:, t.joints.index(j)]
            speed = np.gradient(position, t.time + 1e-12 * np.arange(len(t.time)))
            ends.append(np.quantile([position, speed], _QUANTILES, axis=1).T)
        low, high = np.min(ends, axis=0)[:, 0], np.max(ends, axis=0)[:, 1]
        found[j] = np.stack([low, high], axis=1)
    return found


def _uncovered(
    path: Path, left: Sequence[Path], ranges: dict[Path, dict[str, FloatArray]]
) -> float:
    """Share of the range of positions and speeds that only this recording covers, over joints."""
    lost = 0.0
    for joint, mine in ranges[path].items():
        others = np.array([ranges[q][joint] for q in left if q != path and joint in ranges[q]])
        if not len(others):
            lost += 2.0
            continue
        low, high = others[:, :, 0].min(axis=0), others[:, :, 1].max(axis=0)
        outside = np.maximum(low - mine[:, 0], 0.0) + np.maximum(mine[:, 1] - high, 0.0)
        span = np.maximum(high, mine[:, 1]) - np.minimum(low, mine[:, 0])
        lost += float(np.sum(outside / np.maximum(span, 1e-12)))
    return lost
