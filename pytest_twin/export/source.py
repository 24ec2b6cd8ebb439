"""Read what is exported: a diagnosis or a twin, with the recordings that measure the loss."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.effects import catalogue
from pytest_twin.errors import FormatError, SpecError
from pytest_twin.formats import results
from pytest_twin.formats.content_digest import content_digest
from pytest_twin.formats.paths import decode_text, read_bytes
from pytest_twin.loaded_model import LoadedModel, load_model
from pytest_twin.realization.record_inputs import model_of, refuse_stale_records, unfitted
from pytest_twin.records.basis import Basis, input_parts
from pytest_twin.trial import Trial, make_trials, recording_at
from pytest_twin.twin import Twin

DIAGNOSIS_FILE = "diagnosis.json"
SURE = 0.9
"""Confidence of a finding from which it is exported without a note."""
_MAX_BYTES = 64 * 2**20
_VERDICTS = ("no_mismatch", "explained", "improved", "unexplained")
_MAX_NAMED = 3


@dataclass(frozen=True, slots=True)
class ExportSource:
    """A model with its effects, and what is known about them.

    Attributes:
        path: diagnosis or twin as named by the user.
        loaded: the model.
        findings: findings of a diagnosis, as in ``diagnosis.json``.
        held_out: recordings that were used for no fit.
        notes: what a user must know before the export is used.
        engine: Python of an environment with the target's package, which measures the loss.
    """

    path: Path
    loaded: LoadedModel
    findings: Sequence[Mapping[str, Any]] = ()
    held_out: tuple[Trial, ...] = ()
    notes: tuple[str, ...] = ()
    engine: Path | None = None

    @property
    def patched(self) -> PatchedModel:
        """The effects; none for a model that no diagnosis wrote."""
        return self.loaded.patched or PatchedModel(tuple(self.loaded.realization.joints))


@dataclass(slots=True)
class _Recordings:
    paths: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_source(
    path: Path, recordings: Sequence[Path] = (), engine: Path | None = None
) -> ExportSource:
    """Read a diagnosis or a twin.

    Args:
        path: folder of a diagnosis, ``twin.yaml``, or a model file.
        recordings: recordings to measure with; by default the held-out ones of the diagnosis.
        engine: Python of an environment with the target's package.

    Raises:
        TwinError: it cannot be read, or its files changed since it was made.
    """
    document: dict[str, Any] = {}
    found = _Recordings(list(recordings))
    if path.is_dir() and (path / DIAGNOSIS_FILE).is_file():
        results.check_unchanged(path, DIAGNOSIS_FILE)
        document = _read_document(path / DIAGNOSIS_FILE)
        if not recordings:
            found = _held_out_recordings(document, path)
    loaded = load_model(path)
    twin = loaded.realization.twin
    if document:
        _refuse_changed_model(document, path)
    elif twin is not None:
        refuse_stale_records(twin)
    trials = []
    for recording in found.paths:
        read = recording_at(recording, loaded.topics, loaded.options)
        trials += make_trials(read, loaded.realization.structure, loaded.options)
    findings = document.get("findings", [])
    notes = (*found.notes, *_doubts(document), *_of_the_twin(twin))
    return ExportSource(path, loaded, findings, tuple(trials), notes, engine)


def _read_document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(decode_text(read_bytes(path, _MAX_BYTES), path))
    except (ValueError, RecursionError) as error:
        raise FormatError(f"not JSON: {error}", path=path) from None
    if not isinstance(document, dict) or document.get("schema") != 1:
        schema = document.get("schema") if isinstance(document, dict) else None
        raise FormatError(
            "another schema", path=path, where="schema", value=schema,
            expected="1: a diagnosis by this version of pytest-twin",
        )  # fmt: skip
    if document.get("verdict") not in _VERDICTS:
        raise FormatError(
            "not a diagnosis with a model", path=path, where="verdict",
            value=document.get("verdict"), expected=" or ".join(_VERDICTS),
        )  # fmt: skip
    findings = document.get("findings")
    is_listed = isinstance(findings, list) and all(
        isinstance(finding, dict)
        and isinstance(finding.get("effect"), str)
        and isinstance(finding.get("confidence"), int | float)
        and isinstance(finding.get("parameters"), dict)
        for finding in findings
    )
    if not is_listed:
        raise FormatError(
            "not a list of findings", path=path, where="findings",
            expected="effect, joint, confidence and parameters of each",
        )  # fmt: skip
    return document


def _basis(document: Mapping[str, Any], path: Path) -> Basis | None:
    if "basis" not in document:
        return None
    return Basis.from_json(document["basis"], path / DIAGNOSIS_FILE)


def _refuse_changed_model(document: Mapping[str, Any], path: Path) -> None:
    """Refuse a diagnosis of a model that changed since."""
    basis = _basis(document, path)
    if basis is None or not basis.model:
        return
    source = path / basis.model
    twin_file = source.parent / "twin.yaml"
    if not source.is_file():
        return
    loaded = load_model(twin_file if basis.has_twin and twin_file.is_file() else source)
    realization = loaded.realization
    present = input_parts(
        basis.uses, model_of(unfitted(realization)), realization.twin, has_twin=basis.has_twin
    )
    changed = sorted(
        ident
        for ident, part in basis.parts.items()
        if ident in present and present[ident].content != part.content
    )
    if changed:
        named = ", ".join(changed[:_MAX_NAMED])
        raise SpecError(
            "the diagnosed model changed since the diagnosis", path=source, value=named,
            expected="the model as it was, or pytest-twin diagnose again",
        )  # fmt: skip


def _held_out_recordings(document: Mapping[str, Any], path: Path) -> _Recordings:
    basis = _basis(document, path)
    found = _Recordings()
    trials = document.get("trials")
    names = trials.get("held_out", []) if isinstance(trials, dict) else []
    for name in dict.fromkeys(str(name) for name in names):
        file, digest = (None, None) if basis is None else basis.files.get(name, (None, None))
        recording = None if file is None else (path / file).resolve()
        if recording is None or not recording.is_file():
            found.notes.append(f"held-out recording {name} is not where it was: not measured with")
        elif content_digest(recording) != digest:
            found.notes.append(f"held-out recording {name} changed since: not measured with")
        else:
            found.paths.append(recording)
    return found


def _doubts(document: Mapping[str, Any]) -> list[str]:
    """One line for each finding that is not sure, and for a residual without a name."""
    notes = []
    verdict = document.get("verdict")
    if verdict in ("improved", "unexplained"):
        notes.append(
            f"the diagnosis is '{verdict}': a part of the residual has no name and is not exported"
        )
    laws = catalogue()
    for finding in document.get("findings", []):
        joint = finding.get("joint")
        place = finding["effect"] + ("" if joint is None else f" of {joint}")
        if finding["confidence"] < SURE:
            others = ", ".join(
                str(other.get("effect"))
                for other in finding.get("alternatives", [])
                if isinstance(other, dict)
            )
            instead = f"; it may be {others} instead" if others else ""
            notes.append(
                f"{place} is exported with a confidence of {finding['confidence']:.2f}{instead}"
            )
        law = laws.get(finding["effect"])
        if law is not None and _may_be_absent(law, finding["parameters"]):
            notes.append(f"{place} is exported, but its 95 % interval contains no effect at all")
    return notes


def _of_the_twin(twin: Twin | None) -> list[str]:
    """One line for each part of a twin that no simulator's file holds."""
    if twin is None:
        return []
    notes = []
    if twin.calibration is not None and twin.calibration.joints:
        named = ", ".join(twin.calibration.joints)
        notes.append(
            f"signs, scales and zeros of the encoders of {named} are not exported: the files have "
            "the model's positions"
        )
    if twin.payloads:
        notes.append(f"payloads are not exported: {', '.join(twin.payloads)}")
    return notes


def _may_be_absent(law: Any, parameters: Mapping[str, Any]) -> bool:
    """Whether the intervals of all parameters that switch an effect off contain its absence."""
    intervals = [
        (parameter.neutral, parameters[parameter.reported_name].get("ci95"))
        for parameter in law.parameters
        if parameter.neutral is not None
        and parameter.reciprocal_of is None
        and isinstance(parameters.get(parameter.reported_name), dict)
    ]
    return bool(intervals) and all(
        isinstance(ends, list) and len(ends) == 2 and ends[0] <= neutral <= ends[1]
        for neutral, ends in intervals
    )
