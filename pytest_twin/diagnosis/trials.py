"""Which recordings a diagnosis fits and which it only predicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError, TwinError
from pytest_twin.formats.mcap import Recording, read_recording
from pytest_twin.trial import Trial, make_trial

# Of this many whole recordings one is held out where nobody says which.
_ONE_HELD_OUT_OF = 4


@dataclass(frozen=True, slots=True)
class TrialSet:
    """Trials by role.

    Attributes:
        fit: parameters are fitted on these.
        held_out: no fit sees them; may be empty.
        notes: how roles were decided, what was left out and what is doubtful, one line each.
    """

    fit: tuple[Trial, ...]
    held_out: tuple[Trial, ...]
    notes: tuple[str, ...]


def read_trials(
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    topics: Mapping[str, str],
    structure: Structure,
    *,
    read: Callable[[Path, Mapping[str, str]], Recording] = read_recording,
) -> TrialSet:
    """Read every recording and decide its role.

    ``held_out`` decides where it is given, else the recordings' own metadata ``role``, else whole
    recordings are set aside, the last of every four. A recording that cannot be used is left out
    with a note, unless it is the only one of its role.

    Raises:
        RecordingError: a recording that cannot be used where no other can stand in.
    """
    notes: list[str] = []
    known: dict[Path, Trial] = {}
    first_error: TwinError | None = None
    for path in dict.fromkeys([*recordings, *held_out]):
        try:
            known[path] = make_trial(read(path, topics), structure)
        except TwinError as error:
            first_error = first_error or error
            notes.append(f"left out: {error}")
    trials = [known[p] for p in recordings if p in known and p not in set(held_out)]
    aside = [known[p] for p in held_out if p in known]
    if not trials and (first_error is not None and not aside):
        raise first_error
    if not trials:
        if first_error is not None:
            raise first_error
        raise RecordingError(
            "nothing left to fit: every recording is held out",
            path=held_out[0],
            expected="at least one RECORDING besides --held-out",
        )
    modes = {t.command_mode for t in trials}
    if len(modes) > 1:
        kept = max(modes, key=lambda mode: sum(t.command_mode == mode for t in trials))
        for t in [*trials, *aside]:
            if t.command_mode != kept:
                notes.append(
                    f"left out: {t.path}: {t.command_mode} commands, the others give {kept}; "
                    "diagnose them by themselves"
                )
        trials = [t for t in trials if t.command_mode == kept]
        aside = [t for t in aside if t.command_mode == kept]
    if not held_out:
        trials, aside, said = _by_role(trials)
        notes.append(said)
    elif not aside:
        notes.append("no held-out recording could be used: confidence is limited")
    notes += _doubts([*trials, *aside])
    return TrialSet(tuple(trials), tuple(aside), tuple(notes))


def _by_role(trials: Sequence[Trial]) -> tuple[list[Trial], list[Trial], str]:
    roles = [t.metadata.get("role") for t in trials]
    if "held_out" in roles:
        fit = [t for t, role in zip(trials, roles, strict=True) if role != "held_out"]
        aside = [t for t, role in zip(trials, roles, strict=True) if role == "held_out"]
        if fit:
            return fit, aside, f"held out by their own metadata: {_names(aside)}"
    if len(trials) == 1:
        return (
            list(trials),
            [],
            "one recording only: nothing is held out, so that confidence is limited; record "
            "a second one",
        )
    count = max(1, len(trials) // _ONE_HELD_OUT_OF)
    at = np.linspace(len(trials) - 1, 0, count + 1).round().astype(int)[:count]
    aside = [trials[i] for i in sorted(at)]
    fit = [t for i, t in enumerate(trials) if i not in set(at.tolist())]
    return fit, aside, (
        f"no role is given: whole recordings were split, held out: {_names(aside)} "
        "(--held-out or metadata 'role' decides otherwise)"
    )  # fmt: skip


def _names(trials: Sequence[Trial]) -> str:
    return ", ".join(t.path.name for t in trials)


def _doubts(trials: Sequence[Trial]) -> list[str]:
    """One line per kind of doubt and joint over all recordings."""
    found: dict[tuple[str, str | None, str], list[str]] = {}
    for trial in trials:
        for mark in trial.marks:
            # The file's own words for what other marks say of its stamps.
            if mark.kind == "damage" and "stamps" in mark.text:
                continue
            place = f"{trial.path.name} at {mark.start:.3g} s"
            found.setdefault((mark.kind, mark.joint, mark.topic or ""), []).append(
                f"{place}: {mark.text}"
            )
    lines = []
    for (kind, joint, topic), texts in found.items():
        who = " ".join(part for part in (topic, joint) if part)
        more = f", and {len(texts) - 1} more like it" if len(texts) > 1 else ""
        lines.append(f"{kind.replace('_', ' ')} in {who or 'a file'}: {texts[0]}{more}")
    return lines
