"""A twin, read from ``twin.yaml``: asset, realizations, calibration, fit, controllers, policies."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from pytest_twin.adaptation_spec import ResidualSpec, ShadowPolicy, UpdateSpec, digest_of
from pytest_twin.budget_spec import BudgetSpec
from pytest_twin.errors import SpecError
from pytest_twin.formats import temporary, typed, yaml
from pytest_twin.formats.calibration_record import CalibrationRecord, read_calibration_record
from pytest_twin.formats.identification_record import (
    IdentificationRecord,
    read_identification_record,
)
from pytest_twin.formats.paths import Roots
from pytest_twin.formats.result_record import ResultRecord, read_result_record
from pytest_twin.formats.schema import validate
from pytest_twin.installed import entry_points_by_name
from pytest_twin.ranges_spec import RangesSpec, TrialGroup
from pytest_twin.record_spec import RESULTS_WITH_MODELS, Unaffected, unaffected_of
from pytest_twin.recording_options import NO_OPTIONS, RecordingOptions
from pytest_twin.servos.prior import TwinServo

FILE_NAME = "twin.yaml"
PENDING_ROLLBACK = ".twin/rollback"
"""Folder of a rollback whose files are not yet all in place."""
UNFINISHED_INIT = ".twin/init/before.json"
"""List of files that init found; init locks its folder, and removes it when the twin is whole."""
EFFECTS_FILE = "effects.json"
"""File next to a model that a diagnosis wrote: effects that MJCF cannot express."""
# Model files in the folder of a diagnosis; the first that exists is used.
_DIAGNOSIS_MODELS = ("realization/model.xml", "model.xml")
DEFAULT_TOPICS: Mapping[str, str] = {"state": "/joint_states", "command": "/joint_commands"}
MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
USD_SUFFIXES = (".usd", ".usda", ".usdc")
Simulator = Literal["mujoco", "newton"]
"""Simulator of a realization: MuJoCo for MJCF and URDF, Newton for a USD stage."""
MODEL_FORMATS = "pytest_twin.model_formats"
"""Entry point group of packages that read other formats; the name is the suffix without dot."""

FIT_FAMILIES = ("joint", "actuator", "body", "geom", "pair")

Patch = Mapping[str, float | tuple[float, ...]]
"""Attribute -> value in SI units, as ``schemas/twin.schema.json`` names them."""


@dataclass(frozen=True, slots=True)
class _Section:
    """A table of YAML, its file, and the dotted prefix of its fields in that file."""

    data: Mapping[str, Any]
    path: Path
    prefix: str
    lines: Mapping[str, int]

    @property
    def own_lines(self) -> dict[str, int]:
        """Dotted field without the prefix -> line."""
        return {
            name.removeprefix(self.prefix): line
            for name, line in self.lines.items()
            if name.startswith(self.prefix)
        }

    def error(self, where: str, problem: str, **details: Any) -> SpecError:
        """Return an error at a dotted field of this table, with its line."""
        where = self.prefix + where
        line = _line(self.lines, where)
        return SpecError(problem, path=self.path, line=line, where=where, **details)


@dataclass(frozen=True, slots=True)
class DeclaredEvent:
    """A change of the robot that a person states, such as a new gearbox.

    Attributes:
        date: when, UTC.
    """

    date: datetime
    what: str


@dataclass(frozen=True, slots=True)
class RealizationRef:
    """One realization.

    Attributes:
        simulator: simulator that steps it.
        record: result of the command that fitted the model; None for any other model.
        unaffected: changed inputs of that result that do not touch the model.
    """

    name: str
    file: Path
    simulator: Simulator = "mujoco"
    record: ResultRecord | None = None
    unaffected: tuple[Unaffected, ...] = ()

    @property
    def effects(self) -> Path | None:
        """The effects that a diagnosis wrote next to the model, or None."""
        return effects_file_next_to(self.file)


def effects_file_next_to(model: Path) -> Path | None:
    """The file of effects next to a model, or None."""
    path = model.parent / EFFECTS_FILE
    return path if path.is_file() else None


@dataclass(frozen=True, slots=True)
class Payload:
    """A rigid load that is attached to a body.

    Attributes:
        mass: kg.
        com: (3,) centre of mass in the body's frame, m.
        inertia: (6,) ixx iyy izz ixy ixz iyz about the centre of mass, body axes, kg*m^2.
    """

    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0,) * 6


@dataclass(frozen=True, slots=True)
class JointCalibration:
    """Encoder of a joint: ``model = sign * scale * measured + offset``.

    Attributes:
        offset: rad or m.
        sign: 1.0 or -1.0.
        scale: ratio of the true to the measured displacement.
    """

    offset: float = 0.0
    sign: float = 1.0
    scale: float = 1.0

    @property
    def slope(self) -> float:
        """Derivative of the model's position with respect to the reading."""
        return self.sign * self.scale


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of a frame in another frame.

    Attributes:
        position: (3,) m.
        quaternion: (4,) w x y z, of unit length.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Pose of the robot's base, and calibration of its encoders.

    Attributes:
        transform_world_to_base: pose of the base in the world; None for the model's own.
        joints: joint -> encoder offset, sign and scale.
        path: the file that states it.
        lines: dotted field -> line in ``path``, such as ``joints.elbow.offset``.
    """

    id: str
    transform_world_to_base: Pose | None
    joints: Mapping[str, JointCalibration]
    path: Path
    lines: Mapping[str, int] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, slots=True)
class CalibrationEntry:
    """A record of ``pytest-twin calibrate`` that the twin lists.

    Attributes:
        use: names of the estimates that the twin uses.
        date, instrument: when and with what it was measured, or None.
        supersedes: ids of earlier records that it replaces.
        unaffected: changed inputs that do not touch it.
    """

    record: CalibrationRecord
    use: tuple[str, ...]
    date: str | None = None
    instrument: str | None = None
    supersedes: tuple[str, ...] = ()
    unaffected: tuple[Unaffected, ...] = ()


@dataclass(frozen=True, slots=True)
class Fit:
    """Identified parameters that replace values of the model.

    Attributes:
        patches: ``joint``, ``actuator``, ``body`` or ``geom`` -> element -> attribute -> value.
        option: ``gravity`` (m/s^2) and ``timestep`` (s), where fitted.
        path: the file that states it.
        lines: dotted field -> line in ``path``, such as ``joint.elbow.damping``.
        supersedes: ids of earlier fits that it replaces.
    """

    id: str
    patches: Mapping[str, Mapping[str, Patch]]
    option: Patch
    path: Path
    lines: Mapping[str, int] = field(default_factory=dict, repr=False)
    supersedes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FitEntry:
    """A record of ``pytest-twin identify`` that the twin lists.

    Attributes:
        date: date of the recordings, or None.
        supersedes: ids of earlier records that it replaces.
        unaffected: changed inputs that do not touch it.
    """

    record: IdentificationRecord
    date: str | None = None
    supersedes: tuple[str, ...] = ()
    unaffected: tuple[Unaffected, ...] = ()


@dataclass(frozen=True, slots=True)
class Affects:
    """Rule that selects goldens: those that match every tuple that is not empty.

    Attributes:
        goldens: patterns of golden ids, with ``*`` and ``?``.
        joints: joints; a golden matches if its result depends on one of them.
    """

    kinds: tuple[str, ...] = ()
    goldens: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class DeclaredPart:
    """A dependency that is not part of a model, such as firmware, a table or a temperature.

    At least one of ``id``, ``value`` and ``file`` is not None.

    Attributes:
        name: its name under ``parts:``.
        id: version or serial number.
        value: a number or text.
        file: a file; a change of its content makes goldens stale.
        affects: the goldens that depend on it; None for all.
    """

    name: str
    id: str | None
    value: str | float | None
    file: Path | None
    affects: Affects | None


@dataclass(frozen=True, slots=True)
class AcceptedFinding:
    """A critical finding of the audit with which a release may be signed.

    Attributes:
        owner: person who answers for it.
    """

    reason: str
    owner: str


@dataclass(frozen=True, slots=True)
class ReleasePolicy:
    """Section ``release:`` of ``twin.yaml``.

    Attributes:
        valid_days: validity of a release, days.
    """

    valid_days: float = 90.0


@dataclass(frozen=True, slots=True)
class Authority:
    """Rule that makes a realization authoritative for some goldens.

    Attributes:
        goldens: rule that selects the goldens.
    """

    realization: str
    goldens: Affects


@dataclass(frozen=True, slots=True)
class Edit:
    """Statement that a person changed a file that ``pytest-twin realize`` wrote.

    Attributes:
        reason: what was changed, and why.
        owner: who answers for it.
    """

    reason: str
    owner: str


@dataclass(frozen=True, slots=True)
class FreshPolicy:
    """Smallest displacement for which a change of the twin makes stamped data stale.

    Attributes:
        translation: of the tool centre point or of a slide joint, m.
        rotation: of the tool centre point or of a hinge, rad.
    """

    translation: float = 1e-3
    rotation: float = 1e-2


@dataclass(frozen=True, slots=True)
class Twin:
    """One validated ``twin.yaml``; every path absolute and inside the declared roots.

    Attributes:
        path: the file; ``root``: its folder.
        realizations: name -> file and simulator; ``model:`` is the first, named ``mujoco``.
        source: the supplier's files.
        edited: generated file of the asset -> why it was changed.
        roots: name -> folder outside ``root`` that may contain files of the twin.
        topics: ``state`` and ``command`` -> topic.
        recordings: how to read recordings: joint names, fields, clock, commands between stamps.
        controllers: id -> actuator -> attribute -> value.
        payloads: id -> body -> load.
        motors: motor type -> joints with motors of this type.
        servos: what is known of the drives before any recording.
        parts: name -> declared part.
        calibration: calibration in use: ``calibration:``, updated by ``calibrations:`` and by the
            encoders of ``fit:``.
        calibrated: the same without ``fit:``.
        stated: the same without ``calibrations:`` and ``fit:``.
        calibrations: records of ``pytest-twin calibrate``, the newest last.
        fit: fit in use: all entries of ``fit:`` merged; a later entry overrides an earlier one.
        fit_tables: each entry of ``fit:``, as listed.
        fits: records of ``pytest-twin identify`` under ``fit:``, the newest last.
        tcp: named frame of the tool centre point.
        retired: id of a golden that no longer exists -> reason.
        accepted_findings: id of a critical finding of the audit -> who accepts it, and why.
        release: section ``release:``.
        fresh: smallest displacement that makes stamped data stale.
        excitation: section ``excitation:`` as written, with the limits that a person approved;
            None without it.
        events: declared changes of the robot, by date.
        authority: rules; the first that matches a golden applies.
        residual, update: residual force and online update, or None.
        shadow: criteria for the promotion of a candidate.
        budget: task of the error budget.
        lines: dotted field -> 1-based line in ``path``.
    """

    path: Path
    name: str
    realizations: Mapping[str, RealizationRef]
    source: tuple[Path, ...] = ()
    edited: Mapping[Path, Edit] = field(default_factory=dict)
    roots: Mapping[str, Path] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=lambda: dict(DEFAULT_TOPICS))
    recordings: RecordingOptions = NO_OPTIONS
    controllers: Mapping[str, Mapping[str, Patch]] = field(default_factory=dict)
    payloads: Mapping[str, Mapping[str, Payload]] = field(default_factory=dict)
    motors: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    servos: tuple[TwinServo, ...] = ()
    calibration: Calibration | None = None
    calibrated: Calibration | None = None
    stated: Calibration | None = None
    calibrations: tuple[CalibrationEntry, ...] = ()
    fit: Fit | None = None
    fit_tables: tuple[Fit, ...] = ()
    fits: tuple[FitEntry, ...] = ()
    parts: Mapping[str, DeclaredPart] = field(default_factory=dict)
    tcp: str | None = None
    retired: Mapping[str, str] = field(default_factory=dict)
    accepted_findings: Mapping[str, AcceptedFinding] = field(default_factory=dict)
    release: ReleasePolicy = field(default_factory=ReleasePolicy)
    fresh: FreshPolicy = field(default_factory=FreshPolicy)
    excitation: Mapping[str, Any] | None = None
    events: tuple[DeclaredEvent, ...] = ()
    authority: tuple[Authority, ...] = ()
    residual: ResidualSpec | None = None
    update: UpdateSpec | None = None
    shadow: ShadowPolicy = field(default_factory=ShadowPolicy)
    budget: BudgetSpec = field(default_factory=BudgetSpec)
    ranges: RangesSpec = field(default_factory=RangesSpec)
    lines: Mapping[str, int] = field(default_factory=dict, repr=False)

    @property
    def root(self) -> Path:
        """The twin's folder."""
        return self.path.parent

    @property
    def first_realization(self) -> RealizationRef:
        """The default realization of commands; every twin has at least one."""
        return next(iter(self.realizations.values()))

    @property
    def path_roots(self) -> Roots:
        """Folders that may contain files of this twin."""
        return Roots(self.root, tuple(self.roots.values()))

    @property
    def fits_in_use(self) -> tuple[IdentificationRecord, ...]:
        """Records under ``fit:`` that no later one supersedes, the newest last."""
        return _not_superseded(self.fits)

    @property
    def has_records(self) -> bool:
        """Whether it lists a record or uses a model that a command fitted."""
        results = (self.ranges.record, self.budget.record, *self._written_models)
        return bool(self.fits or self.calibrations or self.ranges.trials or any(results))

    @property
    def _written_models(self) -> tuple[ResultRecord | None, ...]:
        return tuple(reference.record for reference in self.realizations.values())

    @property
    def calibrations_in_use(self) -> tuple[CalibrationEntry, ...]:
        """Entries of ``calibrations:`` that no later one supersedes, the newest last."""
        superseded = {name for entry in self.calibrations for name in entry.supersedes}
        return tuple(entry for entry in self.calibrations if entry.record.id not in superseded)

    def before_fit(self, ident: str) -> Twin:
        """The twin with only the entries of ``fit:`` above one: what its record was fitted with.

        Args:
            ident: id of the entry; of one that is not listed, all are above.
        """
        names = [table.id for table in self.fit_tables]
        if ident not in names:
            return self
        tables = self.fit_tables[: names.index(ident)]
        above = {table.id for table in tables}
        fits = tuple(entry for entry in self.fits if entry.record.id in above)
        in_use = _not_superseded(fits)
        return replace(
            self,
            fit=_merge_fits(_tables_in_use(tables), self.path),
            fit_tables=tables,
            fits=fits,
            calibration=_with_identified_encoders(self.calibrated, in_use, self.path),
        )

    def before_calibration(self, ident: str) -> Twin:
        """The twin with only the entries of ``calibrations:`` above one, and without encoders of
        ``fit:``: what its record was measured with.

        Args:
            ident: id of the record; of one that is not listed, all are above.
        """
        names = [entry.record.id for entry in self.calibrations]
        count = names.index(ident) if ident in names else len(names)
        entries = self.calibrations[:count]
        calibrated = _update_calibration(self.stated, entries, self.path)
        return replace(self, calibrations=entries, calibration=calibrated, calibrated=calibrated)

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that this twin was read from or refers to.

        The realization lists the files that a model includes, and its meshes.
        """
        found: dict[Path, None] = {self.path: None}
        for item in (self.calibration, self.fit):
            if item is not None:
                found[item.path] = None
        for calibration in self.calibrations:
            found[calibration.record.path] = None
        for fit in self.fits:
            found[fit.record.path] = None
        for result in (self.ranges.record, self.budget.record, *self._written_models):
            if result is not None:
                found[result.path] = None
        for ref in self.realizations.values():
            found[ref.file] = None
            if ref.effects is not None:
                found[ref.effects] = None
        for part in self.parts.values():
            if part.file is not None:
                found[part.file] = None
        for adaptation in (self.residual, self.update):
            record = None if adaptation is None else self.shadow_record(adaptation.id)
            if record is not None and record.is_file():
                found[record] = None
        found.update(dict.fromkeys(self.source))
        return tuple(found)

    def authority_of(self, ident: str, kind: str) -> str | None:
        """The authoritative realization of a golden; None where no rule matches."""
        for rule in self.authority:
            kinds, patterns = rule.goldens.kinds, rule.goldens.goldens
            if (not kinds or kind in kinds) and (
                not patterns or any(fnmatchcase(ident, pattern) for pattern in patterns)
            ):
                return rule.realization
        return None

    def shadow_record(self, ident: str) -> Path:
        """Path of the file that records the promotion of a residual or update of this id."""
        return self.root / "shadow" / f"{ident}.json"

    def error(self, where: str, problem: str, **details: Any) -> SpecError:
        """Return an error at a dotted field of ``twin.yaml``, with its line."""
        return _Section({}, self.path, "", self.lines).error(where, problem, **details)


def model_suffixes() -> tuple[str, ...]:
    """Suffixes of model files, lower case: MJCF, URDF, and the formats of installed packages."""
    return (*MODEL_SUFFIXES, *(f".{name}" for name in entry_points_by_name(MODEL_FORMATS)))


def find_twin(start: Path) -> Path | None:
    """The ``twin.yaml`` in ``start`` or the nearest folder above it, or None."""
    start = start.absolute()
    for folder in (start, *start.parents):
        candidate = folder / FILE_NAME
        if candidate.is_file():
            return candidate
    return None


def load_twin(path: Path) -> Twin:
    """Read and check a ``twin.yaml``.

    Raises:
        FormatError: not strict YAML, or beyond its bounds.
        SpecError: a field that is unknown, missing or not valid.
        PathError: a file that does not exist, is a link, or is outside the twin's folder and its
            ``roots``.
    """
    path = path.absolute()
    if (path.parent / PENDING_ROLLBACK).is_dir():
        raise SpecError(
            "a rollback was interrupted, and the files are partly those of a release",
            path=path.parent,
            expected="pytest-twin rollback, which completes it",
        )
    if _is_unfinished(path.parent):
        raise SpecError(
            "init was stopped before this twin was complete",
            path=path.parent,
            expected="pytest-twin init ROBOT again, which sets aside what is there",
        )
    document = yaml.load(path)
    validate(document, schema(), path)
    return _Reader(path, document.data, document.lines).twin()


def _is_unfinished(folder: Path) -> bool:
    files_before = folder / UNFINISHED_INIT
    return files_before.is_file() and temporary.is_abandoned(files_before.parent)


@cache
def schema() -> Mapping[str, Any]:
    """The JSON Schema of ``twin.yaml`` that ships with the package."""
    text = resources.files("pytest_twin").joinpath("schemas/twin.schema.json").read_text("utf-8")
    loaded: Mapping[str, Any] = json.loads(text)
    return loaded


class _Reader:
    """Builds a :class:`Twin` from one validated document."""

    def __init__(self, path: Path, data: Mapping[str, Any], lines: Mapping[str, int]) -> None:
        self.path, self.data, self.lines = path, data, lines
        self.section = _Section(data, path, "", lines)
        self.named_roots = dict(self._roots())
        self.roots = Roots(path.parent, tuple(self.named_roots.values()))

    def twin(self) -> Twin:
        data = self.data
        entries = self._calibrations()
        tables, fits = self._fits()
        stated = self._calibration()
        calibrated = _update_calibration(stated, entries, self.path)
        return Twin(
            path=self.path,
            name=data.get("name") or self.path.parent.name or "twin",
            realizations=self._realizations(),
            source=tuple(
                self._file(name, f"source.{i}") for i, name in enumerate(data.get("source", ()))
            ),
            edited={
                self._file(name, f"edited.{name}"): Edit(stated["reason"], stated["owner"])
                for name, stated in data.get("edited", {}).items()
            },
            roots=self.named_roots,
            topics={**DEFAULT_TOPICS, **data.get("topics", {})},
            recordings=_recordings(data),
            controllers=typed.build(
                {name: actuators or {} for name, actuators in data.get("controllers", {}).items()},
                dict[str, dict[str, Patch]],
            ),
            payloads={
                name: {body: _payload(added) for body, added in bodies.items()}
                for name, bodies in data.get("payloads", {}).items()
            },
            motors=self._motors(),
            servos=self._servos(),
            calibration=_with_identified_encoders(calibrated, _not_superseded(fits), self.path),
            calibrated=calibrated,
            stated=stated,
            calibrations=entries,
            fit=_merge_fits(_tables_in_use(tables), self.path),
            fit_tables=tables,
            fits=fits,
            parts=self._parts(),
            tcp=data.get("tcp"),
            retired=dict(data.get("retired", {})),
            accepted_findings={
                finding: AcceptedFinding(entry["reason"], entry["owner"])
                for entry in data.get("accepted_findings", ())
                for finding in entry["findings"]
            },
            release=typed.build(data.get("release", {}), ReleasePolicy),
            authority=self._authority(),
            residual=self._residual(),
            update=UpdateSpec.from_json(data["update"]) if "update" in data else None,
            shadow=ShadowPolicy.from_json(data.get("shadow", {})),
            budget=self._budget(),
            ranges=self._ranges(),
            fresh=typed.build(data.get("fresh", {}), FreshPolicy),
            excitation=data.get("excitation"),
            events=self._events(),
            lines=self.lines,
        )

    def _motors(self) -> dict[str, tuple[str, ...]]:
        motors = {name: tuple(joints) for name, joints in self.data.get("motors", {}).items()}
        type_of: dict[str, str] = {}
        for name, joints in motors.items():
            for joint in joints:
                if type_of.setdefault(joint, name) != name:
                    raise self.section.error(
                        "a joint has two types of motors", f"motors.{name}", value=joint,
                        expected=f"each joint once; it is also under {type_of[joint]}",
                    )  # fmt: skip
        return motors

    def _servos(self) -> tuple[TwinServo, ...]:
        servos = typed.build(self.data.get("servos", []), tuple[TwinServo, ...])
        owners: dict[str, int] = {}
        for at, servo in enumerate(servos):
            for joint in servo.joints:
                if owners.setdefault(joint, at) != at:
                    raise self.section.error(
                        f"servos.{at}.joints", "a joint has two servos", value=joint,
                        expected=f"each joint once; it is also under servos.{owners[joint]}",
                    )  # fmt: skip
            for name, parameter in servo.parameters.items():
                expected = parameter.expected_of(name)
                if expected:
                    raise self.section.error(
                        f"servos.{at}.parameters.{name}", "wrong parameter of a servo",
                        value=f"{parameter.value} {parameter.unit}, {list(parameter.ci95)}",
                        expected=expected,
                    )  # fmt: skip
        return servos

    def _events(self) -> tuple[DeclaredEvent, ...]:
        found = []
        for at, event in enumerate(self.data.get("events", ())):
            try:
                date = datetime.fromisoformat(str(event["date"]))
            except ValueError:
                raise self.section.error(
                    f"events.{at}.date", "not a date", value=event["date"],
                    expected="2026-05-03 or 2026-05-03T14:30:00+02:00 (ISO 8601)",
                ) from None  # fmt: skip
            zoned = date.replace(tzinfo=UTC) if date.tzinfo is None else date.astimezone(UTC)
            found.append(DeclaredEvent(zoned, event["what"]))
        return tuple(sorted(found, key=lambda event: event.date))

    def _file(self, reference: str, where: str) -> Path:
        return self.roots.resolve(reference, at=self.path, line=_line(self.lines, where))

    def _roots(self) -> Iterator[tuple[str, Path]]:
        declared = self.data.get("roots", {})
        listed = isinstance(declared, list)
        seen: set[str] = set()
        items = enumerate(declared) if listed else declared.items()
        for key, reference in items:
            folder = (self.path.parent / reference).resolve()
            name = folder.name if listed else str(key)
            if not folder.is_dir():
                raise self.section.error(
                    f"roots.{key}", "no such folder", value=reference, expected="a folder"
                )
            if name in seen:
                raise self.section.error(
                    f"roots.{key}",
                    "two roots have this name",
                    value=name,
                    expected="a table, name: folder",
                )
            seen.add(name)
            yield name, folder

    def _realizations(self) -> dict[str, RealizationRef]:
        found: dict[str, RealizationRef] = {}
        if "model" in self.data:
            file = self._model(self.data["model"], "model")
            found["mujoco"] = RealizationRef("mujoco", file, record=_record_of_model(file))
        for name, declared in self.data.get("realizations", {}).items():
            where = f"realizations.{name}"
            if name in found:
                raise self.section.error(
                    where,
                    "'model:' is already the realization of this name",
                    value=name,
                    expected="another name",
                )
            simulator = declared.get("simulator", "mujoco")
            file = self._model(declared["file"], f"{where}.file", simulator)
            record = _record_of_model(file)
            found[name] = RealizationRef(name, file, simulator, record, unaffected_of(declared))
        return found

    def _model(self, reference: str, where: str, simulator: Simulator = "mujoco") -> Path:
        suffix = Path(reference).suffix.lower()
        if simulator == "newton":
            if suffix not in USD_SUFFIXES:
                raise self.section.error(
                    where,
                    "not a file that Newton steps",
                    value=reference,
                    expected="a USD stage (.usd, .usda, .usdc)",
                )
        elif suffix not in model_suffixes():
            if suffix in USD_SUFFIXES:
                raise self.section.error(
                    where,
                    "MuJoCo does not step USD",
                    value=reference,
                    expected="a realization under realizations: with simulator: newton",
                )
            for name in _DIAGNOSIS_MODELS:
                if (self.path.parent / reference / name).is_file():
                    return self._file(f"{reference}/{name}", where)
            raise self.section.error(
                where,
                "not a kind of model that can be loaded",
                value=reference,
                expected="MJCF (.xml, .mjcf), URDF (.urdf), or the folder of a diagnosis",
            )
        return self._file(reference, where)

    def _authority(self) -> tuple[Authority, ...]:
        known = [*(["mujoco"] if "model" in self.data else []), *self.data.get("realizations", {})]
        found = []
        for at, rule in enumerate(self.data.get("authority", ())):
            name = rule["realization"]
            if name not in known:
                raise self.section.error(
                    f"authority.{at}.realization",
                    "no such realization",
                    value=name,
                    expected=", ".join(known),
                )
            found.append(Authority(name, typed.build(rule, Affects)))
        return tuple(found)

    def _table_of(self, key: str) -> _Section | None:
        """The table of ``key``: inline, or from its ``file:``; None without one."""
        data = self.data.get(key)
        if data is None:
            return None
        if "file" not in data:
            return _Section(data, self.path, f"{key}.", self.lines)
        path = self._file(data["file"], f"{key}.file")
        document = yaml.load(path)
        validate(document, {**schema()["$defs"][key], "$defs": schema()["$defs"]}, path)
        return _Section(document.data, path, "", document.lines)

    def _calibration(self) -> Calibration | None:
        section = self._table_of("calibration")
        if section is None:
            return None
        base = section.data.get("base")
        return Calibration(
            id=str(section.data["id"]),
            transform_world_to_base=None if base is None else _pose(base, section),
            joints=typed.build(section.data.get("joints", {}), dict[str, JointCalibration]),
            path=section.path,
            lines=section.own_lines,
        )

    def _calibrations(self) -> tuple[CalibrationEntry, ...]:
        found: list[CalibrationEntry] = []
        for at, data in enumerate(self.data.get("calibrations", ())):
            where = f"calibrations.{at}"
            record = read_calibration_record(self._file(data["file"], f"{where}.file"))
            earlier = [entry.record.id for entry in found]
            if record.verdict != "accepted":
                raise self.section.error(
                    f"{where}.file",
                    "a calibration that is not accepted",
                    value=record.verdict,
                    expected="a calibration.json whose verdict is accepted",
                )
            self._check_id("calibration", record.id, f"{where}.file", where, data, earlier)
            entry = CalibrationEntry(
                record,
                tuple(data.get("use", ("joint_zeros",))),
                data.get("date"),
                data.get("instrument"),
                tuple(data.get("supersedes", ())),
                unaffected_of(data),
            )
            superseded = {name for one in (*found, entry) for name in one.supersedes}
            for other in found:
                # An external measurement of joint zeros may refine the home position of an encoder.
                refined = {_zero_of(j) for j in other.record.homes if j not in record.homes}
                twice = (_estimates_in_use(other) & _estimates_in_use(entry)) - refined
                if twice and other.record.id not in superseded:
                    raise self.section.error(
                        where,
                        f"{sorted(twice)[0]} is in two calibrations",
                        value=f"{other.record.id}, {record.id}",
                        expected=f"supersedes: [{other.record.id}], or use: with other records",
                    )
            self._check_homes(entry, where)
            found.append(entry)
        return tuple(found)

    def _check_id(
        self,
        noun: str,
        own: str,
        place: str,
        where: str,
        data: Mapping[str, Any],
        earlier: Collection[str],
    ) -> None:
        """Check that a record has a new id, and supersedes only records above it.

        Args:
            noun: the kind of record, in the singular.
            place: field that the id comes from.
            where, data: path and fields of the record's entry in the twin.
            earlier: ids of the entries above it.

        Raises:
            SpecError: it does not.
        """
        if own in earlier:
            raise self.section.error(
                place,
                f"two {noun}s of one id",
                value=own,
                expected=f"a different id for each {noun}",
            )
        for name in data.get("supersedes", ()):
            if name not in earlier:
                raise self.section.error(
                    f"{where}.supersedes",
                    f"no earlier {noun} of this id",
                    value=name,
                    expected=f"ids of {noun}s above it: " + (", ".join(earlier) or "none"),
                )

    def _check_homes(self, entry: CalibrationEntry, where: str) -> None:
        """Check that each home position was measured with the sign that the twin states."""
        calibration = self._calibration()
        stated = {} if calibration is None else calibration.joints
        for joint, sign in entry.record.homes.items():
            mine = stated.get(joint, JointCalibration()).sign
            if "joint_zeros" in entry.use and sign != mine:
                raise self.section.error(
                    f"{where}.file",
                    f"the home of {joint} was found with another sign of its encoder",
                    value=sign,
                    expected=f"{mine:g}, as calibration.joints.{joint} states it; measure the home "
                    "with robot: twin.yaml",
                )

    def _fits(self) -> tuple[tuple[Fit, ...], tuple[FitEntry, ...]]:
        """The tables under ``fit:`` as listed, and the records of the list."""
        data = self.data.get("fit")
        if not isinstance(data, list):
            section = self._table_of("fit")
            return (() if section is None else (_fit(section),)), ()
        tables: dict[str, Fit] = {}
        entries: list[FitEntry] = []
        for at, one in enumerate(data):
            where = f"fit.{at}"
            if "file" not in one:
                found = _fit(_Section(one, self.path, f"{where}.", self.lines))
            else:
                entry = self._fit_entry(one, where)
                entries.append(entry)
                found = Fit(entry.record.id, entry.record.fit, {}, entry.record.path)
            self._check_id("fit", found.id, where, where, one, tables)
            tables[found.id] = replace(found, supersedes=tuple(one.get("supersedes", ())))
        return tuple(tables.values()), tuple(entries)

    def _fit_entry(self, data: Mapping[str, Any], where: str) -> FitEntry:
        record = read_identification_record(self._file(data["file"], f"{where}.file"))
        if record.verdict != "accepted":
            raise self.section.error(
                f"{where}.file",
                "an identification that is not accepted",
                value=record.verdict,
                expected="an identification.json whose verdict is accepted",
            )
        supersedes = tuple(data.get("supersedes", ()))
        return FitEntry(record, data.get("date"), supersedes, unaffected_of(data))

    def _parts(self) -> dict[str, DeclaredPart]:
        """Declared parts; residual and update are added as parts that every golden depends on."""
        data = self.data
        found = {name: self._part(name, d) for name, d in data.get("parts", {}).items()}
        residual = self._residual()
        update = UpdateSpec.from_json(data["update"]) if "update" in data else None
        for name, spec in (("residual", residual), ("update", update)):
            if spec is None:
                continue
            if name in found:
                raise self.section.error(
                    f"parts.{name}",
                    f"'{name}:' is already a part of the twin",
                    expected="another name",
                )
            file = spec.file if isinstance(spec, ResidualSpec) else None
            found[name] = DeclaredPart(name, spec.id, digest_of(spec, None), file, None)
        return found

    def _residual(self) -> ResidualSpec | None:
        data = self.data.get("residual")
        if data is None:
            return None
        needed = "function" if data["kind"] == "function" else "file"
        if needed not in data:
            raise self.section.error(
                "residual", f"a residual of kind {data['kind']} without {needed!r}",
                expected=f"{needed}:",
            )  # fmt: skip
        for joint, region in data["joints"].items():
            for name in ("position", "velocity"):
                low, high = region[name]
                if not low < high:
                    raise self.section.error(
                        f"residual.joints.{joint}.{name}",
                        "an empty region",
                        value=f"[{low}, {high}]",
                        expected="the lower end first",
                    )
        file = self._file(data["file"], "residual.file") if "file" in data else None
        return ResidualSpec.from_json(data, file)

    def _budget(self) -> BudgetSpec:
        data = self.data.get("budget", {})
        files = enumerate(data.get("recordings", ()))
        found = tuple(self._recording(name, f"budget.recordings.{at}") for at, name in files)
        return BudgetSpec.from_json(data, found, self._result("budget", data))

    def _ranges(self) -> RangesSpec:
        data = self.data.get("ranges", {})
        final, held_out = (
            tuple(
                self._recording(name, f"ranges.{key}.{at}")
                for at, name in enumerate(data.get(key, ()))
            )
            for key in ("final", "held_out")
        )
        trials = tuple(
            TrialGroup(
                read_identification_record(self._file(one["file"], f"ranges.trials.{at}.file")),
                {k: float(v) for k, v in one.items() if k not in ("file", "unaffected")},
                unaffected_of(one),
            )
            for at, one in enumerate(data.get("trials", ()))
        )
        return RangesSpec.from_json(data, final, held_out, trials, self._result("ranges", data))

    def _result(self, section: str, data: Mapping[str, Any]) -> ResultRecord | None:
        """The result of ``budget`` or ``randomize`` that a section names as in use, or None."""
        if "file" not in data:
            return None
        return read_result_record(self._file(data["file"], f"{section}.file"))

    def _recording(self, reference: str, where: str) -> Path:
        """Path of a recording: a file, or a folder that is one recording."""
        folder = (self.path.parent / reference).is_dir()
        line = _line(self.lines, where)
        return self.roots.resolve(reference, at=self.path, line=line, where=where, folder=folder)

    def _part(self, name: str, data: Mapping[str, Any]) -> DeclaredPart:
        ident, value, affects = data.get("id"), data.get("value"), data.get("affects")
        file = data.get("file")
        return DeclaredPart(
            name=name,
            id=None if ident is None else str(ident),
            value=value,
            file=None if file is None else self._file(file, f"parts.{name}.file"),
            affects=typed.build(affects, Affects) if affects else None,
        )


def _record_of_model(model: Path) -> ResultRecord | None:
    """The result beside a model that a diagnosis or identification wrote, or None."""
    if effects_file_next_to(model) is None:
        return None
    for name in RESULTS_WITH_MODELS:
        path = model.parent.parent / name
        if path.is_file():
            return read_result_record(path)
    return None


def _fit(section: _Section) -> Fit:
    return Fit(
        id=str(section.data["id"]),
        patches=typed.build(
            {family: section.data.get(family, {}) for family in FIT_FAMILIES},
            dict[str, dict[str, Patch]],
        ),
        option=typed.build(section.data.get("option", {}), dict[str, float | tuple[float, ...]]),
        path=section.path,
        lines=section.own_lines,
    )


def _tables_in_use(tables: tuple[Fit, ...]) -> list[Fit]:
    superseded = {name for table in tables for name in table.supersedes}
    return [table for table in tables if table.id not in superseded]


def _merge_fits(fits: list[Fit], path: Path) -> Fit | None:
    """Merge fits, attribute by attribute; a later fit overrides an earlier one."""
    if len(fits) < 2:
        return fits[0] if fits else None
    patches: dict[str, dict[str, Patch]] = {family: {} for family in FIT_FAMILIES}
    option: Patch = {}
    for fit in fits:
        option = {**option, **fit.option}
        for family, elements in fit.patches.items():
            for name, patch in elements.items():
                patches[family][name] = {**patches[family].get(name, {}), **patch}
    return Fit("+".join(fit.id for fit in fits), patches, option, path)


def _estimates_in_use(entry: CalibrationEntry) -> set[str]:
    """Estimates that a twin uses of a record: ``zero of JOINT`` and ``base_world``."""
    found = set()
    if "joint_zeros" in entry.use:
        found |= {_zero_of(joint) for joint in entry.record.joint_zeros}
    if "base_world" in entry.use and entry.record.base_world is not None:
        found.add("base_world")
    return found


def _zero_of(joint: str) -> str:
    return f"zero of {joint}"


def _update_calibration(
    stated: Calibration | None, entries: tuple[CalibrationEntry, ...], path: Path
) -> Calibration | None:
    """The calibration in use: the stated one, updated by the records that are not superseded."""
    superseded = {name for entry in entries for name in entry.supersedes}
    in_use = [
        entry for entry in entries if entry.record.id not in superseded and _estimates_in_use(entry)
    ]
    if not in_use:
        return stated
    joints = {} if stated is None else dict(stated.joints)
    base = None if stated is None else stated.transform_world_to_base
    for entry in in_use:
        if "joint_zeros" in entry.use:
            for joint, value in entry.record.joint_zeros.items():
                # The estimate uses the stated sign and replaces the stated offset.
                joints[joint] = replace(joints.get(joint, JointCalibration()), offset=value)
        if "base_world" in entry.use and entry.record.base_world is not None:
            (x, y, z), (w, a, b, c) = entry.record.base_world
            base = Pose((x, y, z), (w, a, b, c))
    ids = [*([] if stated is None else [stated.id]), *(entry.record.id for entry in in_use)]
    return Calibration(
        id="+".join(ids),
        transform_world_to_base=base,
        joints=joints,
        path=path if stated is None else stated.path,
        lines={} if stated is None else stated.lines,
    )


def _not_superseded(fits: tuple[FitEntry, ...]) -> tuple[IdentificationRecord, ...]:
    superseded = {name for entry in fits for name in entry.supersedes}
    return tuple(entry.record for entry in fits if entry.record.id not in superseded)


def _with_identified_encoders(
    calibrated: Calibration | None, records: tuple[IdentificationRecord, ...], path: Path
) -> Calibration | None:
    """The calibration, updated by the encoders that identifications estimated.

    An estimate that started from another calibration of the encoder is ignored: a later
    calibration has measured the encoder.
    """
    stated = {} if calibrated is None else calibrated.joints
    joints = dict(stated)
    changed = []
    for record in records:
        for joint, change in record.encoders.items():
            if stated.get(joint, JointCalibration()) == JointCalibration(**change.before):
                joints[joint] = JointCalibration(**change.after)
                changed.append(record.id)
    if not changed:
        return calibrated
    ids = [*([] if calibrated is None else [calibrated.id]), *dict.fromkeys(changed)]
    none = Calibration("", None, {}, path)
    return replace(calibrated or none, id="+".join(ids), joints=joints)


def _line(lines: Mapping[str, int], where: str) -> int | None:
    """The line of a field, or of the nearest field that contains it."""
    while where:
        if where in lines:
            return lines[where]
        where = where.rpartition(".")[0]
    return None


def _payload(data: Mapping[str, Any]) -> Payload:
    x, y, z = (float(v) for v in data.get("com", (0.0, 0.0, 0.0)))
    inertia = [float(v) for v in data.get("inertia", ())]
    ixx, iyy, izz, ixy, ixz, iyz = inertia + [0.0] * (6 - len(inertia))
    return Payload(float(data["mass"]), (x, y, z), (ixx, iyy, izz, ixy, ixz, iyz))


def _recordings(data: Mapping[str, Any]) -> RecordingOptions:
    """Options of recordings; the twin's ``command_between`` is a default that metadata override."""
    options = RecordingOptions.from_json(data)
    return replace(options, command_between=None, command_between_default=options.command_between)


def _pose(data: Mapping[str, Any], section: _Section) -> Pose:
    x, y, z = (float(v) for v in data.get("position", (0.0, 0.0, 0.0)))
    w, a, b, c = (float(v) for v in data.get("quaternion", (1.0, 0.0, 0.0, 0.0)))
    norm = math.sqrt(w * w + a * a + b * b + c * c)
    if abs(norm - 1.0) > 1e-3:
        raise section.error(
            "base.quaternion",
            "not a rotation",
            value=f"length {norm:.6g}",
            expected="w x y z of length 1",
        )
    return Pose((x, y, z), (w / norm, a / norm, b / norm, c / norm))
