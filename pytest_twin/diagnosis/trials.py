"""Which recordings a diagnosis fits and which it only predicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pytest_twin.dependency import Structure
from pytest_twin.errors import RecordingError, TwinError
from pytest_twin.formats.mcap import Recording, read_recording
from pytest_twin.trial import FloatArray, Trial, make_trial

# Of this many whole recordings one is held out where nobody says which.
_ONE_HELD_OUT_OF = 4
# States follow commands with this correlation before their ratio is called one of units.
_FOLLOWS = 0.9
_LIKE = 0.15
_COUNTS = 100.0
# An encoder that stands still for this share of a recording under a moving command is stuck.
_STUCK_SHARE = 0.6
# Friction holds a joint at rest only so far: a setpoint that sweeps, seen from the encoder, this
# many times as wide as it ever did from a moving one would have moved it.
_HELD_SWEEP = 2.0
# Share of messages with the very same greatest speed.
_CLIPPED = 0.02


@dataclass(frozen=True, slots=True)
class TrialSet:
    """Trials by role.

    Attributes:
        fit: parameters are fitted on these.
        held_out: no fit sees them; may be empty.
        notes: how roles were decided, what was left out and what is doubtful, one line each.
        unseen: joints whose encoder is stuck; what they read is held against nothing.
    """

    fit: tuple[Trial, ...]
    held_out: tuple[Trial, ...]
    notes: tuple[str, ...]
    unseen: frozenset[str] = frozenset()


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
            _refuse_other_unit(known[path])
        except TwinError as error:
            known.pop(path, None)
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
    unseen = _unseen(trials, aside, notes)
    if not held_out:
        trials, aside, said = _by_role(trials)
        notes.append(said)
    elif not aside:
        notes.append("no held-out recording could be used: confidence is limited")
    notes += _doubts([*trials, *aside])
    return TrialSet(tuple(trials), tuple(aside), tuple(notes), unseen)


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


def _unseen(trials: list[Trial], aside: list[Trial], notes: list[str]) -> frozenset[str]:
    """Leave out recordings with a stuck encoder where others remain, else the joint itself."""

    everything = (*trials, *aside)

    def stuck(trial: Trial) -> set[str]:
        # For a while dry friction holds a joint as well; a dead encoder stays where it is.
        still: dict[str, float] = {}
        for m in trial.marks:
            if m.kind == "stuck" and m.joint is not None:
                still[m.joint] = still.get(m.joint, 0.0) + m.end - m.start
        return {
            j
            for j, seconds in still.items()
            if seconds > _STUCK_SHARE * trial.duration
            and not _friction_could_hold(trial, j, everything)
        }

    bad = [t for t in [*trials, *aside] if stuck(t)]
    sound_fit = [t for t in trials if not stuck(t)]
    sound_aside = [t for t in aside if not stuck(t)]
    if not bad:
        return frozenset()
    if sound_fit and (sound_aside or not aside):
        for t in bad:
            notes.append(
                f"left out: {t.path}: the encoder of {', '.join(sorted(stuck(t)))} is stuck"
            )
        trials[:], aside[:] = sound_fit, sound_aside
        return frozenset()
    joints = frozenset(j for t in bad for j in stuck(t))
    if all(j in joints for t in [*trials, *aside] for j in t.joints):
        raise RecordingError(
            "every encoder is stuck while its command moves",
            path=bad[0].path,
            value=", ".join(sorted(joints)),
            expected="positions that follow",
        )
    notes += [f"joint {j!r}: its encoder is stuck; nothing is held against it" for j in
              sorted(joints)]  # fmt: skip
    return joints


def _friction_could_hold(trial: Trial, joint: str, trials: Sequence[Trial]) -> bool:
    """Whether an encoder that stands still may be that of a joint at rest under its friction.

    While it stands, the setpoint sweeps no wider than friction allows: what setpoints needed to
    move the joint elsewhere in the recording, or in others of the same controller, is the measure.
    Nobody can tell where it never moved, nor where a setpoint is no position.
    """
    if trial.command_mode != "position":
        return False
    error, still = _tracking_error(trial, joint)
    controller = trial.metadata.get("controller")
    alike = [t for t in trials if joint in t.joints and t.metadata.get("controller") == controller]
    needed = 0.0
    for other in alike:
        seen, at_rest = _tracking_error(other, joint)
        if (~at_rest).sum() > 1:
            needed = max(needed, float(np.ptp(seen[~at_rest])))
    return not still.any() or float(np.ptp(error[still])) <= _HELD_SWEEP * needed


def _tracking_error(trial: Trial, joint: str) -> tuple[FloatArray, NDArray[np.bool_]]:
    """(n,) setpoint minus position, rad or m, and where the encoder stands still."""
    position = trial.position[:, trial.joints.index(joint)]
    if joint not in trial.command_joints:
        return np.zeros_like(position), np.ones(len(position), dtype=bool)
    held = np.searchsorted(trial.command_time, trial.time, side="right") - 1
    sent = trial.command[np.maximum(held, 0), trial.command_joints.index(joint)]
    moves = np.concatenate([[False], np.diff(position) != 0.0])
    still = trial.marked(joint, ("stuck",)) & ~moves
    if not moves.any():
        still[:] = True
    return sent - position, still


def _refuse_other_unit(trial: Trial) -> None:
    """Positions many times what is commanded, in a constant ratio, are in another unit.

    Raises:
        RecordingError: the ratio is that of degrees, or far from one.
    """
    if trial.command_mode != "position":
        return
    for column, joint in enumerate(trial.joints):
        if joint not in trial.command_joints:
            continue
        sent = trial.command[:, trial.command_joints.index(joint)]
        held = np.searchsorted(trial.command_time, trial.time, side="right") - 1
        sent = sent[np.maximum(held, 0)]
        sent, seen = (
            sent - sent.mean(),
            trial.position[:, column] - trial.position[:, column].mean(),
        )
        power = float(sent @ sent)
        both = np.sqrt(power * float(seen @ seen))
        if both <= 0.0 or float(sent @ seen) / both < _FOLLOWS:
            continue
        ratio = float(sent @ seen) / power
        for factor, name in ((np.degrees(1.0), "degrees"), (np.radians(1.0), "radians")):
            if abs(np.log(ratio / factor)) < _LIKE:
                raise RecordingError(
                    f"states move {ratio:.3g} times as far as commands, as if in {name}",
                    path=trial.path,
                    where=f"joint '{joint}'",
                    expected="one unit, rad (m where it slides)",
                )
        if ratio > _COUNTS or ratio < 1.0 / _COUNTS:
            raise RecordingError(
                f"states move {ratio:.3g} times as far as commands, as if in encoder counts",
                path=trial.path,
                where=f"joint '{joint}'",
                expected="one unit, rad (m where it slides)",
            )


def _clipped(trial: Trial) -> list[str]:
    """Joints whose measured velocity stands at its own greatest value for a while."""
    lines: list[str] = []
    if trial.velocity is None:
        return lines
    for column, joint in enumerate(trial.joints):
        speed = np.abs(trial.velocity[:, column])
        top = float(np.nanmax(speed, initial=0.0))
        share = float(np.mean(speed == top))
        if top > 0.0 and share > _CLIPPED:
            lines.append(
                f"{trial.path.name}: velocity of {joint} stands at {top:.4g} in "
                f"{100 * share:.0f} % of the messages, as if clipped; positions are what counts"
            )
    return lines


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
    lines = [line for trial in trials for line in _clipped(trial)]
    for (kind, joint, topic), texts in found.items():
        who = " ".join(part for part in (topic, joint) if part)
        more = f", and {len(texts) - 1} more like it" if len(texts) > 1 else ""
        lines.append(f"{kind.replace('_', ' ')} in {who or 'a file'}: {texts[0]}{more}")
    return lines
