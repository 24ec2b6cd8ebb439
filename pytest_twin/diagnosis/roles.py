"""Roles of recordings in a diagnosis: fit, validation, test.

Effects are chosen with the fit and validation recordings. Their parameters are then fitted to both.
The test recordings are used once, after that. All reported errors and gains are measured on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.trial_settings import ROLES
from pytest_twin.diagnosis.trials import TrialSet
from pytest_twin.trial import Trial

_QUANTILES = (0.02, 0.98)
"""Quantiles that bound the range of a motion; values outside may be outliers."""
_CONDITIONS = ("controller", "payload", "temperature")


@dataclass(frozen=True, slots=True)
class Roles:
    """Trials by role.

    Attributes:
        fit: parameters are fitted to these trials while effects are chosen.
        validation: effects are accepted on these trials, which are not fitted during the search;
            empty if there are too few recordings.
        test: trials that are used after the effects are chosen and fitted; may be empty.
        note: how the validation recordings were chosen, one line.
        read: all trials and their notes.
    """

    fit: tuple[Trial, ...]
    validation: tuple[Trial, ...]
    test: tuple[Trial, ...]
    note: str
    read: TrialSet

    @property
    def of_search(self) -> TrialSet:
        """The trials for the search: fit and validation recordings, no test recordings."""
        return replace(self.read, fit=self.fit, held_out=self.validation)


def roles_of(read: TrialSet) -> Roles:
    """Choose validation recordings among those to fit.

    Whole recordings of one fifth to one third of the recorded time are used for validation. Every
    condition (controller, payload, temperature) keeps recordings to fit. Recordings whose range of
    positions and speeds is best covered by the others are chosen. The order of the recordings does
    not matter. With fewer than four recordings all are fitted, and effects are accepted by
    the prediction of each from the others.

    Args:
        read: the trials to fit, and the held-out ones, which become test trials.
    """
    paths = sorted(dict.fromkeys(t.path for t in read.fit), key=str)
    if len(paths) < ROLES.fewest_recordings:
        return Roles(read.fit, (), read.held_out, _of_few(len(paths)), read)
    chosen = _choose_validation(paths, read.fit)
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
        f"{which} to fit, too few to set one aside for validation: effects are accepted by the "
        f"prediction of {'its parts' if count == 1 else 'each from the others'}; with "
        f"{ROLES.fewest_recordings} or more recordings some are used for validation"
    )


def _of_different(count: int) -> str:
    return (
        f"{count} recordings to fit, too few to validate under every controller, payload and "
        "temperature: none is set aside for validation; effects are accepted by the prediction of "
        "each from the others"
    )


def _choose_validation(paths: Sequence[Path], trials: Sequence[Trial]) -> set[Path]:
    """Paths of the validation recordings; empty if not every condition can have one."""
    of = {p: [t for t in trials if t.path == p] for p in paths}
    seconds = {p: sum(t.duration for t in of[p]) for p in paths}
    kind = {p: tuple(of[p][0].metadata.get(c) for c in _CONDITIONS) for p in paths}
    ranges = {p: _ranges(of[p]) for p in paths}
    whole = sum(seconds.values())
    chosen: set[Path] = set()

    def used_share(p: Path) -> float:
        """Share of the recorded time of a condition that is already used for validation."""
        alike = [q for q in paths if kind[q] == kind[p]]
        return sum(seconds[q] for q in alike if q in chosen) / sum(seconds[q] for q in alike)

    def covers_all() -> bool:
        return {kind[p] for p in chosen} == set(kind.values())

    while sum(seconds[p] for p in chosen) < ROLES.least_share * whole or not covers_all():
        to_fit = [p for p in paths if p not in chosen]
        possible = [
            p for p in to_fit
            if sum(kind[q] == kind[p] for q in to_fit) > 1
            and sum(seconds[q] for q in (*chosen, p)) <= ROLES.most_share * whole
        ]  # fmt: skip
        if not possible:
            break
        chosen.add(
            min(
                possible,
                key=lambda p: (used_share(p), _own_share(p, to_fit, ranges), str(p)),
            )
        )
    # An effect that acts under one condition only (cold, one payload) must be validated there.
    return chosen if covers_all() else set()


def _ranges(trials: Sequence[Trial]) -> dict[str, FloatArray]:
    """Joint -> (2, 2): lower and upper bound of positions (first row) and velocities (second)."""
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


def _own_share(
    path: Path, left: Sequence[Path], ranges: dict[Path, dict[str, FloatArray]]
) -> float:
    """Share of the position and velocity ranges that only ``path`` covers, summed over joints."""
    lost = 0.0
    for joint, own in ranges[path].items():
        others = np.array([ranges[q][joint] for q in left if q != path and joint in ranges[q]])
        if not len(others):
            lost += 2.0
            continue
        low, high = others[:, :, 0].min(axis=0), others[:, :, 1].max(axis=0)
        outside = np.maximum(low - own[:, 0], 0.0) + np.maximum(own[:, 1] - high, 0.0)
        span = np.maximum(high, own[:, 1]) - np.minimum(low, own[:, 0])
        lost += float(np.sum(outside / np.maximum(span, 1e-12)))
    return lost
