"""Whether the records of a twin still match their inputs, and what changed where they do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_twin.dependency import Part, Structure
from pytest_twin.errors import SpecError
from pytest_twin.formats.calibration_record import CalibrationRecord
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.formats.result_record import ResultRecord
from pytest_twin.outcome import Reason
from pytest_twin.record_spec import Unaffected
from pytest_twin.records.basis import EARLIER_RECORD, Basis, input_parts
from pytest_twin.staleness import DependencyMap, Model, changes, joint_calibration
from pytest_twin.twin import Twin

Record = IdentificationRecord | CalibrationRecord | ResultRecord
SourceOf = Callable[[str | Path], Model]
"""Name of a realization, or path of another model -> its parts before any record replaces them."""
_SHOWN_DIGITS = 12
"""Number of hexadecimal digits of a digest in messages: enough that two changes differ."""
_TRIALS = "ranges.trials"
_MAX_NAMED = 3
"""Largest number of changes of a record that a message names."""
_ABSENT = Part("absent", {})
_SOURCE = "/source/"
"""Follows the name of the realization in ids of parts with the model's own values."""


@dataclass(frozen=True, slots=True)
class FileDigests:
    """Functions that return a digest of a file, hex; None where the twin has no such file.

    Attributes:
        content: of what it states, without comments and layout.
        sha256: of its bytes.
    """

    content: Callable[[Path], str | None]
    sha256: Callable[[Path], str | None]


@dataclass(frozen=True, slots=True)
class InputChange:
    """One input of a record that differs from the time when the record was made.

    Attributes:
        digest: SHA-256 of its present content, hex.
        reasons: changed fields with old and new value.
        accepted: statement of the owner that this change does not touch the record, or None.
    """

    part: str
    digest: str
    reasons: tuple[Reason, ...]
    accepted: Unaffected | None = None


@dataclass(frozen=True, slots=True)
class RecordState:
    """A record in use, and the changes of its inputs.

    Attributes:
        kind: command that makes it.
        where: its place in ``twin.yaml``, such as ``fit.0``.
        uses: estimates that the twin uses of a calibration; empty for any other record.
        models: realizations whose model its command wrote.
        changes: inputs that changed.
        notes: what could not be compared.
        statements: changes that its owner declared harmless.
        inputs: ids of all of its inputs.
        overrides: values of ``twin.yaml`` that it replaces.
    """

    kind: str
    where: str
    record: Record
    statements: tuple[Unaffected, ...] = ()
    uses: tuple[str, ...] = ()
    models: tuple[str, ...] = ()
    changes: tuple[InputChange, ...] = ()
    notes: tuple[str, ...] = ()
    inputs: frozenset[str] = frozenset()
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @property
    def touching(self) -> tuple[InputChange, ...]:
        """Changes that no owner declared harmless: with any, the record is stale."""
        return tuple(change for change in self.changes if change.accepted is None)

    def accepted(self, change: InputChange) -> InputChange:
        """Return a change with the statement of the owner that accepts it, if there is one."""
        for stated in self.statements:
            if stated.part == change.part and change.digest.startswith(stated.digest):
                return replace(change, accepted=stated)
        return change

    @property
    def part(self) -> Part:
        """The state as a part that goldens depend on."""
        return Part(
            f"basis:{self.record.id}",
            {
                change.part: {
                    "digest": change.digest,
                    **({} if change.accepted is None else {"accepted": change.accepted.reason}),
                }
                for change in self.changes
            }
            | ({"overrides": self.overrides} if self.overrides else {}),
        )

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Why the goldens of a stale record are stale."""
        return tuple(
            replace(reason, part=f"{self.record.id}, made with {reason.part}")
            for change in self.touching
            for reason in change.reasons
        )

    def as_error(self, twin: Twin) -> SpecError:
        """The error of a stale record, with the ways out."""
        touching = self.touching
        named = [_in_words(change) for change in touching[:_MAX_NAMED]]
        if len(touching) > _MAX_NAMED:
            named.append(f"and {len(touching) - _MAX_NAMED} more")
        statements = ", ".join(
            f"{{part: '{change.part}', digest: {change.digest[:_SHOWN_DIGITS]}, "
            'reason: "WHY", owner: "WHO"}'
            for change in touching
        )
        return twin.error(
            self.where,
            f"record {self.record.id!r} is stale: its inputs changed: " + "; ".join(named),
            expected=f"pytest-twin {self.kind} again, or if it does not touch the record, "
            f"here unaffected: [{statements}]",
        )

    def overridden(self, structure: Structure) -> frozenset[str]:
        """Ids of the parts, of a realization and of the twin, that the record determines."""
        name, record = structure.realization, self.record
        found: set[str] = set()
        if name in self.models:
            found |= structure.part_ids
        if isinstance(record, ResultRecord):
            return frozenset(found)
        if isinstance(record, CalibrationRecord):
            found.add(f"record:{record.id}")
            if "joint_zeros" in self.uses:
                found |= {f"calibration:{joint}" for joint in record.joint_zeros}
            if "base_world" in self.uses and record.base_world is not None:
                roots = {structure.ancestors(body)[-1] for body in structure.body_tree}
                found |= {f"{name}/kinematics:{body}" for body in roots} | {"base:calibration"}
            return frozenset(found)
        found.add(f"fit:{record.id}")
        fitted = record.fit
        for body, values in fitted.get("body", {}).items():
            found |= {f"{name}/inertia:{body}"}
            if not values.keys().isdisjoint(("pos", "quat")):
                found |= {f"{name}/kinematics:{body}"}
        found |= {f"{name}/joint:{joint}" for joint in fitted.get("joint", {})}
        found |= {f"{name}/actuator:{actuator}" for actuator in fitted.get("actuator", {})}
        for geom in fitted.get("geom", {}):
            found |= {f"{name}/geom:{geom}"}
            if geom in structure.geom_body:
                found |= {f"{name}/collision:{structure.geom_body[geom]}"}
        if fitted.get("pair"):
            found.add(f"{name}/contact:pairs")
        found |= {f"calibration:{joint}" for joint in record.encoders}
        found |= {f"encoder:{joint}" for joint in record.encoder_steps}
        found |= {f"sensor:{sensor.name}" for sensor in record.sensors}
        return frozenset(found)


def _in_words(change: InputChange) -> str:
    return "; ".join(str(reason) for reason in change.reasons)


def record_states(twin: Twin, source_of: SourceOf, digests: FileDigests) -> tuple[RecordState, ...]:
    """Compare the inputs of each record in use with the present ones.

    Raises:
        TwinError: a record or a model cannot be read.
    """
    states = []
    for state, before in _records_in_use(twin):
        if state.record.basis is None:
            compared = _with_changed_files(state, twin, digests)
        else:
            compared = _with_changed_inputs(state, before, twin, source_of, digests)
        states.append(
            replace(
                compared,
                changes=tuple(compared.accepted(one) for one in compared.changes),
                overrides=_overrides(state, before),
            )
        )
    return tuple(states)


def _overrides(state: RecordState, before: Twin) -> dict[str, Any]:
    """Values of ``twin.yaml`` that a record replaces."""
    record = state.record
    if isinstance(record, CalibrationRecord):
        calibration = before.calibration
        if calibration is None:
            return {}
        zeros = record.joint_zeros if "joint_zeros" in state.uses else {}
        found: dict[str, Any] = {
            joint: joint_calibration(calibration.joints[joint])
            for joint in zeros
            if joint in calibration.joints
        }
        pose = calibration.transform_world_to_base
        if pose is not None and "base_world" in state.uses and record.base_world is not None:
            found["base"] = {
                "position [m]": list(pose.position),
                "quaternion": list(pose.quaternion),
            }
        return found
    if not isinstance(record, IdentificationRecord) or before.fit is None:
        return {}
    values = {
        f"{family}.{name}.{attribute}": value
        for family, elements in record.fit.items()
        for name, fitted in elements.items()
        for attribute, value in before.fit.patches.get(family, {}).get(name, {}).items()
        if attribute in fitted
    }
    return dict(values)


def _records_in_use(twin: Twin) -> Iterator[tuple[RecordState, Twin]]:
    """Each record in use, and the twin that it was made with."""
    listed = [table.id for table in twin.fit_tables]
    in_use = {record.id for record in twin.fits_in_use}
    for fit in twin.fits:
        if (ident := fit.record.id) in in_use:
            where = f"fit.{listed.index(ident)}"
            yield (
                RecordState(
                    "identify",
                    where,
                    fit.record,
                    fit.unaffected,
                    models=_models_of(fit.record.path, twin),
                ),
                twin.before_fit(ident),
            )
    for at, group in enumerate(twin.ranges.trials):
        # It is not used as a fit; which fits it was made with is not known.
        without = replace(twin, fit=None, fit_tables=(), fits=(), calibration=twin.calibrated)
        yield (
            RecordState("identify", f"{_TRIALS}.{at}", group.record, group.unaffected),
            without,
        )
    yield from ((state, twin) for state in _results_in_use(twin))
    for at, entry in enumerate(twin.calibrations):
        if entry in twin.calibrations_in_use:
            yield (
                RecordState(
                    "calibrate", f"calibrations.{at}", entry.record, entry.unaffected, entry.use
                ),
                twin.before_calibration(entry.record.id),
            )


def _results_in_use(twin: Twin) -> Iterator[RecordState]:
    """Results that sections of the twin name, and those beside models that a command wrote."""
    listed = {fit.record.path for fit in twin.fits}
    for name, reference in twin.realizations.items():
        record = reference.record
        if record is not None and record.path not in listed:
            kind = "diagnose" if record.path.name == "diagnosis.json" else "identify"
            where = f"realizations.{name}" if f"realizations.{name}" in twin.lines else "model"
            yield RecordState(
                kind, where, record, reference.unaffected, models=_models_of(record.path, twin)
            )
    if twin.ranges.record is not None:
        yield RecordState("randomize", "ranges", twin.ranges.record, twin.ranges.unaffected)
    if twin.budget.record is not None:
        yield RecordState("budget", "budget", twin.budget.record, twin.budget.unaffected)


def _models_of(record: Path, twin: Twin) -> tuple[str, ...]:
    return tuple(
        name
        for name, reference in twin.realizations.items()
        if reference.record is not None and reference.record.path == record
    )


def model_of_basis(basis: Basis, record: Record, twin: Twin) -> str | Path | None:
    """Realization that a record was made with, or the path of another model, or None.

    A realization is found by its file, or by the file's name where the record was moved. The model
    that the command wrote beside the record is the result, never the input.
    """
    if not basis.model:
        return None
    path = (record.path.parent / basis.model).resolve()
    for name, reference in twin.realizations.items():
        if reference.file.resolve() == path:
            return name
    if twin.path_roots.contains(path) and path.is_file():
        return path
    written = _models_of(record.path, twin)
    names = [
        name
        for name, reference in twin.realizations.items()
        if reference.file.name == path.name and name not in written
    ]
    return names[0] if names else None


def _with_changed_inputs(
    state: RecordState, before: Twin, twin: Twin, source_of: SourceOf, digests: FileDigests
) -> RecordState:
    record, notes = state.record, list[str]()
    assert record.basis is not None
    basis = Basis.from_json(record.basis, record.path)
    model = model_of_basis(basis, record, twin)
    found: list[InputChange] = []
    if model is None and basis.model:
        notes.append(
            f"record {record.id!r} was made with {basis.model}, which this twin does not have: "
            "whether that model changed is not known"
        )
    elif model is not None:
        today = input_parts(basis.uses, source_of(model), before, has_twin=basis.has_twin)
        found += _changed_parts(basis.parts, today, state)
    for name, (file, digest) in basis.files.items():
        present = digests.content((record.path.parent / file).resolve())
        if present is not None and present != digest:
            found.append(_changed_file(name, digest, present))
    inputs = {*basis.parts, *(f"file:{name}" for name in basis.files)}
    inputs |= {change.part for change in found}
    return replace(state, changes=tuple(found), notes=tuple(notes), inputs=frozenset(inputs))


def _changed_parts(
    then: Mapping[str, Part], today: Mapping[str, Part], state: RecordState
) -> Iterator[InputChange]:
    for ident in sorted(then.keys() | today.keys()):
        old, new = then.get(ident, _ABSENT), today.get(ident, _ABSENT)
        if old.digest == new.digest:
            continue
        if ident.startswith(EARLIER_RECORD) and (
            state.where.startswith(_TRIALS) or _is_replaced(old, new, state)
        ):
            continue
        named = Part(ident, old.content), Part(ident, new.content)
        yield InputChange(ident, new.digest, tuple(changes(*named)))


def _is_replaced(old: Part, new: Part, state: RecordState) -> bool:
    """Whether an earlier record was removed and the record itself has all of its values."""
    if new is not _ABSENT:
        return False
    if state.models:
        # A model that a command wrote contains the values of the records before it.
        return True
    return isinstance(state.record, IdentificationRecord) and all(
        set(values) <= set(state.record.fit.get(family, {}).get(name, {}))
        for family, elements in old.content.items()
        for name, values in elements.items()
    )


def _changed_file(name: str, old: str, new: str) -> InputChange:
    digits = slice(0, _SHOWN_DIGITS)
    return InputChange(
        f"file:{name}", new, (Reason(f"file:{name}", "content", old[digits], new[digits]),)
    )


def _with_changed_files(state: RecordState, twin: Twin, digests: FileDigests) -> RecordState:
    """Compare the files of a record that states only their SHA-256."""
    record, found = state.record, list[InputChange]()
    models = {reference.file.name: reference.file for reference in twin.realizations.values()}
    for name, sha256 in record.inputs.items():
        if Path(name).name == twin.path.name:
            # The record itself was added to it.
            continue
        folders = (record.path.parent, record.path.parent.parent, twin.root)
        paths = [models.get(Path(name).name), *(folder / name for folder in folders)]
        present = [
            digest
            for path in paths
            if path is not None and (digest := digests.sha256(path.resolve())) is not None
        ]
        if present and sha256 not in present:
            found.append(_changed_file(name, sha256, present[0]))
    compared = (
        "the SHA-256 of its files is compared, so that a comment counts as a change, and changes "
        f"of {twin.path.name} are not seen"
        if record.inputs
        else "whether they changed is not known"
    )
    note = (
        f"record {record.id!r} does not state which inputs it used (an earlier version made it): "
        f"{compared}; pytest-twin {state.kind} again states them"
    )
    inputs = frozenset(f"file:{name}" for name in record.inputs)
    return replace(state, changes=tuple(found), notes=(note,), inputs=inputs)


def with_records(
    dependencies: DependencyMap, states: Sequence[RecordState], models: Mapping[str, Model]
) -> DependencyMap:
    """Add, to each golden, the states of the records that its result depends on, and the values
    of the model that ``fit:`` replaces.

    The result does not depend on a replaced value, but a change of it is a change of the robot.
    """
    parts = {**dependencies.parts, **{state.part.id: state.part for state in states}}
    depends_on = {}
    for key, ids in dependencies.depends_on.items():
        model = models.get(key.rpartition("@")[2])
        added: set[str] = set()
        if model is not None:
            added |= {
                state.part.id
                for state in states
                if not ids.isdisjoint(state.overridden(model.structure))
            }
            sources = [source_part(model.replaced[ident]) for ident in ids & model.replaced.keys()]
            added |= {part.id for part in sources}
            parts.update({part.id: part for part in sources})
        depends_on[key] = ids | added
    return DependencyMap(parts, depends_on)


def source_part(replaced: Part) -> Part:
    """Part with the model's own values, beside the part of the same id with the values in use."""
    realization, _, name = replaced.id.partition("/")
    return Part(f"{realization}{_SOURCE}{name}", replaced.content)


def is_source_part(ident: str) -> bool:
    """Whether a part has the model's own values, which ``fit:`` replaces."""
    return _SOURCE in ident.partition(":")[0]


def stale_lines(states: Sequence[RecordState], twin: Twin) -> tuple[str, ...]:
    """Return one line for each stale record."""
    return tuple(str(state.as_error(twin)) for state in states if state.touching)


def with_reasons_of_records(
    reasons: Sequence[Reason], states: Sequence[RecordState], ids: frozenset[str]
) -> tuple[Reason, ...]:
    """Return the reasons why a golden is stale, with the changed inputs of stale records.

    Args:
        reasons: changes of parts since the release.
        ids: parts that the golden depends on.
    """
    stale = [state for state in states if state.touching and state.part.id in ids]
    # The changed inputs say more than that the state of the record changed.
    explained = {state.part.id for state in stale}
    return (
        *(
            reason
            for reason in reasons
            if reason.part not in explained and not (stale and is_source_part(reason.part))
        ),
        *(reason for state in stale for reason in state.reasons),
    )


def unknown_statements(states: Sequence[RecordState], twin: Twin) -> Iterator[SpecError]:
    """Errors for statements under ``unaffected:`` of parts that are no inputs of the record."""
    for state in states:
        for at, stated in enumerate(state.statements):
            if stated.part not in state.inputs:
                yield twin.error(
                    f"{state.where}.unaffected.{at}.part",
                    f"no input of record {state.record.id!r}",
                    value=stated.part,
                    expected="a changed input, as pytest names it",
                )
