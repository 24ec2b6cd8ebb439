"""Reading of recordings for a diagnosis: which are fitted, held out, or left out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pytest_twin.dependency import Structure
from pytest_twin.diagnosis.trial_settings import TRIALS
from pytest_twin.errors import RecordingError, TwinError
from pytest_twin.formats.recording import Recording
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.trial.common_stamps import resample_to_common_stamps
from pytest_twin.trial.repeated_motion import without_repeated
from pytest_twin.trial.roles import refuse_final


@dataclass(frozen=True, slots=True)
class TrialSet:
    """Trials by role.

    Attributes:
        fit: trials to which parameters are fitted.
        held_out: trials that are predicted and not fitted; may be empty.
        notes: roles, trials that were left out, and doubts, one line each.
        unseen: joints whose encoder is stuck in ``fit``; their error is not evaluated.
        untested: joints whose encoder is stuck in ``held_out``; their error there is not evaluated.
        earlier: recordings of the robot before a change. The residual of the model in them counts
            as noise in the others.
    """

    fit: tuple[Trial, ...]
    held_out: tuple[Trial, ...]
    notes: tuple[str, ...]
    unseen: frozenset[str] = frozenset()
    untested: frozenset[str] = frozenset()
    earlier: tuple[Trial, ...] = ()


def read_trials(
    recordings: Sequence[Path],
    held_out: Sequence[Path],
    topics: Mapping[str, str],
    structure: Structure,
    options: RecordingOptions = NO_OPTIONS,
    episodes: Mapping[Path, Collection[int]] | None = None,
) -> TrialSet:
    """Read all recordings and decide their roles.

    ``held_out`` decides if it is given, else the metadata ``role``. Otherwise one of every four
    whole recordings is held out. An unusable recording is left out with a note, unless it is the
    only one of its role, and so is one with the motion of another one. Held-out recordings do not
    influence how the others are read.

    Args:
        held_out: recordings that are not fitted; they need not be among ``recordings``.
        topics: role -> topic.
        options: how recordings are read.
        episodes: data set -> indices of its episodes that are used, from 0; all if it is absent.

    Raises:
        RecordingError: no usable recording remains to be fitted.
    """
    notes: list[str] = []
    known: dict[Path, list[Trial]] = {}
    first_error: TwinError | None = None
    for path in dict.fromkeys([*recordings, *held_out]):
        chosen = None if episodes is None else episodes.get(path)
        for read in _each_recording(path, topics, options, chosen):
            try:
                if isinstance(read, TwinError):
                    raise read
                refuse_final(read.metadata, read.path, "a diagnosis")
                parts = [
                    resample_to_common_stamps(t) for t in make_trials(read, structure, options)
                ]
            except TwinError as error:
                first_error = first_error or error
                notes.append(f"left out: {error}")
                continue
            for trial in parts:
                try:
                    _refuse_too_few(trial)
                except TwinError as error:
                    first_error = first_error or error
                    notes.append(f"left out: {error}")
                else:
                    known.setdefault(path, []).append(trial)
    trials = [t for p in recordings if p not in set(held_out) for t in known.get(p, ())]
    aside = [t for p in held_out for t in known.get(p, ())]
    if not trials:
        if first_error is not None:
            raise first_error
        raise RecordingError(
            "no recording remains to fit: every one is held out",
            path=held_out[0],
            expected="at least one RECORDING that is not under --held-out",
        )
    split = None if held_out else _by_metadata(trials)
    if split is not None:
        trials, aside, said = split
        notes.append(said)
    trials, aside = without_repeated(trials, aside, notes)
    trials = _of_one_mode(trials, None, notes)
    aside = _of_one_mode(aside, _modes(trials[0]), notes)
    usual = _usual_joints(trials)
    trials = _with_joints(trials, usual, notes)
    aside = _with_joints(aside, usual, notes)
    trials, unseen = _exclude_stuck_encoders(trials, notes)
    unseen |= _find_motionless_joints(trials, unseen, notes)
    aside, untested = _exclude_stuck_in_test(aside, notes)
    if not held_out and split is None:
        trials, aside, said = _by_count(trials)
        notes.append(said)
    elif not aside:
        notes.append("no held-out recording could be used; confidence is at most 90 %")
    notes += _reading_notes([*trials, *aside])
    notes += _doubtful_data_notes([*trials, *aside])
    notes += _notes_on_many_turns([*trials, *aside], structure)
    once = tuple(dict.fromkeys(notes))
    return TrialSet(tuple(trials), tuple(aside), once, unseen, untested)


def _each_recording(
    path: Path,
    topics: Mapping[str, str],
    options: RecordingOptions,
    chosen: Collection[int] | None,
) -> Sequence[Recording | TwinError]:
    """The recordings of a path (of a data set: the chosen episodes), or the error of reading it."""
    try:
        found = recordings_at(path, topics, options)
    except TwinError as error:
        return [error]
    return found if chosen is None else [r for i, r in enumerate(found) if i in chosen]


def _by_metadata(trials: Sequence[Trial]) -> tuple[list[Trial], list[Trial], str] | None:
    """Fit trials, held-out trials and a note, by the metadata; None if it holds out none or all."""
    roles = [t.metadata.get("role") for t in trials]
    fit = [t for t, role in zip(trials, roles, strict=True) if role != "held_out"]
    aside = [t for t, role in zip(trials, roles, strict=True) if role == "held_out"]
    if not fit or not aside:
        return None
    return fit, aside, f"held out (role in the metadata): {_names(aside)}"


def _by_count(trials: Sequence[Trial]) -> tuple[list[Trial], list[Trial], str]:
    """Fit trials, held-out trials and a note: every fourth recording is held out, none of one."""
    # Parts of one recording share temperature and sensor zeros, so they have the same role.
    paths = list(dict.fromkeys(t.path for t in trials))
    if len(paths) == 1:
        return (
            list(trials),
            [],
            "one recording only: nothing is held out, and confidence is at most 90 %; make a "
            "second recording",
        )
    count = max(1, len(paths) // TRIALS.one_held_out_of)
    at = np.linspace(len(paths) - 1, 0, count + 1).round().astype(int)[:count]
    chosen = {paths[i] for i in at}
    aside = [t for t in trials if t.path in chosen]
    fit = [t for t in trials if t.path not in chosen]
    return fit, aside, (
        f"held out (chosen automatically): {_names(aside)}; choose with --held-out or with 'role' "
        "in the metadata"
    )  # fmt: skip


def _of_one_mode(trials: list[Trial], kept: str | None, notes: list[str]) -> list[Trial]:
    """The trials with one command mode: ``kept``, or the most common one."""
    modes = [_modes(t) for t in trials]
    kept = kept or max(modes, key=modes.count)
    notes += [
        f"left out: {t.path}: it has {mode} commands, most others have {kept} commands; diagnose "
        "it separately"
        for t, mode in zip(trials, modes, strict=True)
        if mode != kept
    ]
    return [t for t, mode in zip(trials, modes, strict=True) if mode == kept]


def _modes(trial: Trial) -> str:
    """The command mode of a trial in words: one for all joints, or one for each joint."""
    if trial.command_mode != "mixed":
        return trial.command_mode
    pairs = sorted(zip(trial.command_joints, trial.command_modes, strict=True))
    return ", ".join(f"{joint} {mode}" for joint, mode in pairs)


def _reading_notes(trials: Sequence[Trial]) -> list[str]:
    """Decisions made while reading, one line each, with the names of the recordings."""
    found: dict[str, list[str]] = {}
    for trial in trials:
        for note in trial.notes:
            found.setdefault(note, []).append(trial.path.name)
    lines = [f"{', '.join(dict.fromkeys(names))}: {note}" for note, names in found.items()]
    if any(t.between_source == "assumed" for t in trials):
        lines.append(
            "commands are taken as held between their stamps (assumed: neither the recordings nor "
            "twin.yaml say it; --command-between)"
        )
    return lines


def _usual_joints(trials: Sequence[Trial]) -> list[str]:
    """Joints that more than half of the recordings have."""
    joints = dict.fromkeys(j for t in trials for j in t.joints)
    return [j for j in joints if 2 * sum(j in t.joints for t in trials) > len(trials)]


def _with_joints(trials: list[Trial], usual: Sequence[str], notes: list[str]) -> list[Trial]:
    """The trials that have all joints ``usual``; all trials if none has them.

    A joint with an unknown position moves the rest of the robot. If no recording has all joints,
    the incomplete joints are left out later.
    """
    whole = [t for t in trials if set(usual) <= set(t.joints)]
    if not whole:
        return trials
    for t in trials:
        lacking = [j for j in usual if j not in t.joints]
        if lacking:
            notes.append(
                f"left out: {t.path}: it lacks {', '.join(lacking)}, which most others have"
            )
    return whole


def _exclude_stuck_encoders(
    trials: list[Trial], notes: list[str]
) -> tuple[list[Trial], frozenset[str]]:
    """The trials without a stuck encoder; if there are none, all trials and the stuck joints.

    Raises:
        RecordingError: every encoder is stuck.
    """

    def stuck(trial: Trial) -> set[str]:
        # Dry friction also holds a joint for some time, but not for most of a recording.
        still: dict[str, float] = {}
        for m in trial.marks:
            if m.kind == "stuck" and m.joint is not None:
                still[m.joint] = still.get(m.joint, 0.0) + m.end - m.start
        return _copied(trial) | {
            j
            for j, seconds in still.items()
            if seconds > TRIALS.stuck_share * trial.duration and not _friction_could_hold(trial, j)
        }

    bad = [t for t in trials if stuck(t)]
    sound = [t for t in trials if not stuck(t)]
    if sound:
        for t in bad:
            why = "copies the commands" if stuck(t) <= _copied(t) else "is stuck"
            notes.append(f"left out: {t.path}: the encoder of {', '.join(sorted(stuck(t)))} {why}")
        return sound, frozenset()
    joints = frozenset(j for t in bad for j in stuck(t))
    if all(j in joints for t in trials for j in t.joints):
        raise RecordingError(
            "every encoder is stuck while its command moves",
            path=bad[0].path,
            value=", ".join(sorted(joints)),
            expected="positions that follow the commands",
        )
    for j in sorted(joints):
        why = "copies its command" if any(j in _copied(t) for t in bad) else "is stuck"
        notes.append(f"joint {j!r}: its encoder {why}; its error is not evaluated")
    return trials, joints


def _copied(trial: Trial) -> set[str]:
    """Joints whose positions are copies of their commands."""
    return {m.joint for m in trial.marks if m.kind == "copied" and m.joint is not None}


def _exclude_stuck_in_test(
    aside: list[Trial], notes: list[str]
) -> tuple[list[Trial], frozenset[str]]:
    """As :func:`_exclude_stuck_encoders` for held-out trials; none if all encoders are stuck."""
    if not aside:
        return aside, frozenset()
    try:
        return _exclude_stuck_encoders(aside, notes)
    except RecordingError as error:
        notes.append(f"left out: {error}")
        return [], frozenset()


def _find_motionless_joints(
    trials: Sequence[Trial], unseen: frozenset[str], notes: list[str]
) -> frozenset[str]:
    """Joints with effort commands and a constant position in all trials.

    Under effort commands a stuck encoder cannot be distinguished from a blocked joint, so their
    error is not evaluated. For other joints with a constant position a note says that their noise
    is unknown.

    Raises:
        RecordingError: no joint moves.
    """
    joints = [j for j in trials[0].joints if all(j in t.joints for t in trials)]
    readings = {j: np.concatenate([t.position[:, t.joints.index(j)] for t in trials])
                for j in joints}  # fmt: skip
    still = {j: float(q[0]) for j, q in readings.items() if not np.ptp(q)}
    if joints and len(still) == len(joints):
        raise RecordingError(
            "every joint has the same position in all messages of all recordings",
            path=trials[0].path,
            value=", ".join(f"{j} {at:.6g}" for j, at in still.items()),
            expected="a joint that moves",
        )
    dead = set()
    for j, at in still.items():
        said = f"joint {j!r}: its encoder reads {at:.6g} in every message"
        if trials[0].mode_of(j) == "effort":
            dead.add(j)
            notes.append(f"{said}: the encoder is stuck or the joint is blocked; its error is not "
                         "evaluated")  # fmt: skip
        elif j not in unseen:
            notes.append(
                f"{said}, so its noise is unknown; the largest noise of the others is assumed"
            )
    return frozenset(dead)


def _friction_could_hold(trial: Trial, joint: str) -> bool:
    """Whether dry friction may be the reason for a constant encoder position.

    The joint must have moved in the same trial, and its tracking error must vary no more at rest
    than friction allows. Only position commands show this.
    """
    if trial.mode_of(joint) != "position":
        return False
    position = trial.position[:, trial.joints.index(joint)]
    if float(np.ptp(position)) < TRIALS.least_travel:
        return False
    sent = trial.commands_before(trial.time)[:, trial.command_joints.index(joint)]
    error = sent - position
    still = trial.marked(joint, ("stuck",))
    return float(np.ptp(error[still])) <= TRIALS.held_sweep * float(np.ptp(error[~still]))


def _refuse_too_few(trial: Trial) -> None:
    """Refuse a trial that is too short to estimate the noise of its sensors.

    Raises:
        RecordingError: the trial is too short.
    """
    if trial.parts > 1 and trial.duration < TRIALS.shortest_part:
        raise RecordingError(
            "a part between gaps is too short for a diagnosis",
            path=trial.path,
            where=f"from {trial.offset:.4g} s",
            value=f"{trial.duration:.3g}",
            unit="s",
            expected=f"at least {TRIALS.shortest_part:g} s",
        )
    count = len(np.unique(trial.time))
    if count < TRIALS.fewest_samples:
        raise RecordingError(
            "too few states for a diagnosis",
            path=trial.path,
            value=str(count),
            expected=f"at least {TRIALS.fewest_samples}, each at a different time",
        )


def _notes_on_clipped_velocities(trial: Trial) -> list[str]:
    """A line for each joint whose measured velocity is constant at its largest value at times."""
    lines: list[str] = []
    if trial.velocity is None:
        return lines
    for column, joint in enumerate(trial.joints):
        speed = np.abs(trial.velocity[:, column])
        top = float(np.nanmax(speed, initial=0.0))
        share = float(np.mean(speed == top))
        if top > 0.0 and share > TRIALS.clipped_share:
            lines.append(
                f"{trial.path.name}: the velocity of {joint} is at its maximum of {top:.4g} in "
                f"{100 * share:.0f} % of the messages and seems to be clipped; the diagnosis uses "
                "positions"
            )
    return lines


def _notes_on_many_turns(trials: Sequence[Trial], structure: Structure) -> list[str]:
    """A line for each hinge that makes so many turns that its unit is doubtful."""
    lines = {}
    for trial in trials:
        for column, joint in enumerate(trial.joints):
            travel = float(np.ptp(trial.position[:, column]))
            if (
                structure.joint_type.get(joint) == "hinge"
                and travel > TRIALS.far_travel
                and joint not in lines
            ):
                lines[joint] = (
                    f"{trial.path.name}: {joint} moves through {travel:.3g} rad "
                    f"({travel / (2.0 * np.pi):.2g} turns); if states and commands are in degrees "
                    "or counts, convert them to rad"
                )
    return list(lines.values())


def _names(trials: Sequence[Trial]) -> str:
    return ", ".join(dict.fromkeys(t.path.name for t in trials))


def _doubtful_data_notes(trials: Sequence[Trial]) -> list[str]:
    """A line for each kind of doubtful data and each joint, over all trials."""
    found: dict[tuple[str, str | None, str], list[str]] = {}
    for trial in trials:
        for mark in trial.marks:
            # Other marks report the same doubt about stamps in plainer words.
            if mark.kind == "damage" and "stamps" in mark.text:
                continue
            place = f"{trial.path.name} at {trial.offset + mark.start:.3g} s"
            found.setdefault((mark.kind, mark.joint, mark.topic or ""), []).append(
                f"{place}: {mark.text}"
            )
    lines = [line for trial in trials for line in _notes_on_clipped_velocities(trial)]
    for (kind, joint, topic), texts in found.items():
        who = " ".join(part for part in (topic, joint) if part)
        more = f", and {len(texts) - 1} similar" if len(texts) > 1 else ""
        lines.append(f"{kind.replace('_', ' ')} in {who or 'a file'}: {texts[0]}{more}")
    return lines
