"""First ``replay`` goldens for the recordings given to ``init``; runs in the child process."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from pytest_twin.checks.files import find_recording
from pytest_twin.errors import SpecError, TwinError
from pytest_twin.gate.specs import UNWRITTEN
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial, make_trials, recordings_at
from pytest_twin.trial.roles import refuse_final
from pytest_twin.twin import load_twin
from pytest_twin.words import list_names

# A data set may have hundreds of episodes, and each golden is a simulation of one.
_MAX_EPISODES = 5
_KINDS = {"hinge": ("angle_max", "5 mrad"), "slide": ("position_max", "0.5 mm")}


def first_replays(
    twin: str, recordings: Sequence[str], tolerance: Mapping[str, Any], progress: Any
) -> dict[str, Any]:
    """Create first specs of kind ``replay``.

    Args:
        twin: path of ``twin.yaml``.
        recordings: references to recordings, relative to the twin's folder or one of its roots.
        tolerance: fields of :class:`pytest_twin.setup.recordings.TaskTolerance`.
        progress: called with the fraction that is done, 0 to 1.

    Returns:
        ``specs``, and ``silent``: recording -> why it has no spec.

    Raises:
        SpecError: a tolerance for a joint that the model lacks, or with the wrong unit for it.
    """
    loaded = load_twin(Path(twin))
    first = loaded.first_realization
    realization = load(first.file, twin=loaded, name=first.name)
    _check_joints(realization, tolerance["joints"])
    stems = Counter(PurePosixPath(recording).stem for recording in recordings)
    specs: list[dict[str, Any]] = []
    silent: dict[str, str] = {}
    for done, recording in enumerate(recordings):
        stem = PurePosixPath(recording).stem
        called = stem if stems[stem] == 1 else recording
        try:
            path = find_recording(recording, loaded)
            found = recordings_at(path, loaded.topics, loaded.recordings)
        except TwinError as error:
            silent[recording] = str(error)
            continue
        for number, read in enumerate(found[:_MAX_EPISODES]):
            episode = number if len(found) > 1 else None
            end = "" if episode is None else f" episode {episode}"
            try:
                refuse_final(read.metadata, path, "a golden")
                trials = make_trials(read, realization.structure, loaded.recordings)
            except TwinError as error:
                silent[f"{recording}{end}"] = str(error)
                continue
            target = _target(recording, episode)
            name = f"{called}{end.replace(' ', '_')}"
            specs.append({"name": name, **_spec(realization, target, trials, tolerance)})
        if len(found) > _MAX_EPISODES:
            silent[recording] = (
                f"{len(found) - _MAX_EPISODES} of {len(found)} episodes, from "
                f"{_MAX_EPISODES} to {len(found) - 1}; to test one of them too, copy a golden "
                "and change its target.episode"
            )
        progress((done + 1) / len(recordings))
    return {"specs": specs, "silent": silent}


def _check_joints(realization: Realization, joints: Mapping[str, Mapping[str, str]]) -> None:
    types = realization.structure.joint_type
    for joint, own in joints.items():
        kind = types.get(joint)
        if kind not in _KINDS:
            known = [name for name, found in types.items() if found in _KINDS]
            raise SpecError(
                "no hinge or slide joint of this name",
                where="--tolerance",
                value=joint,
                expected=f"one of {list_names(known, 12)}",
            )
        wanted, example = _KINDS[kind]
        if wanted not in own:
            raise SpecError(
                f"joint {joint!r} is a {kind}",
                where="--tolerance",
                value=", ".join(own.values()),
                expected=f"a unit that fits, such as {example!r}",
            )


def _target(recording: str, episode: int | None) -> dict[str, Any]:
    return {"recording": recording} | ({} if episode is None else {"episode": episode})


def _spec(
    realization: Realization,
    target: dict[str, Any],
    trials: Sequence[Trial],
    tolerance: Mapping[str, Any],
) -> dict[str, Any]:
    types = realization.structure.joint_type
    recorded = [joint for joint in trials[0].joints if types.get(joint) in _KINDS]
    own = {joint: dict(given) for joint, given in tolerance["joints"].items() if joint in recorded}
    general: dict[str, str] = {}
    blank = False
    for kind, (name, example) in _KINDS.items():
        if any(types[joint] == kind and joint not in own for joint in recorded):
            blank |= name not in tolerance["general"]
            general[name] = tolerance["general"].get(name, f"{UNWRITTEN} {example}>")
    if own:
        target["joints"] = {joint: own.get(joint) for joint in recorded}
    notes = []
    if blank:
        notes.append(
            "To write: the largest difference between prediction and recording that the task "
            "allows. Derive it from the task, before you see a result; the golden fails until then."
        )
    notes += [f"Of the recording: {note}" for note in trials[0].notes]
    notes += _variants(realization, trials[0])
    seconds = sum(trial.duration for trial in trials)
    called = PurePosixPath(target["recording"]).name
    if "episode" in target:
        called += f", episode {target['episode']}"
    return {
        "title": f"Replay of {called}, {seconds:.3g} s, against what was measured",
        "target": target,
        "tolerance": general,
        "notes": notes,
    }


def _variants(realization: Realization, trial: Trial) -> list[str]:
    """Notes on a controller or payload of the recording that ``twin.yaml`` does not declare."""
    twin = realization.twin
    assert twin is not None
    return [
        f"The recording names the {kind} {named!r}; twin.yaml declares none under {kind}s:, so the "
        "nominal model is replayed."
        for kind, declared in (("controller", twin.controllers), ("payload", twin.payloads))
        if (named := trial.metadata.get(kind)) and not declared
    ]
