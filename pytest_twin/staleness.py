"""Dependency map: the parts that each golden depends on, and which goldens a change made stale.

This module uses no simulator and reads no files.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from typing import Any, Protocol

from pytest_twin.dependency import Part, Structure, canonical
from pytest_twin.errors import SpecError
from pytest_twin.formats.calibration_record import CalibrationRecord
from pytest_twin.formats.identification_record import IdentificationRecord
from pytest_twin.golden import Golden
from pytest_twin.outcome import Reason
from pytest_twin.twin import Affects, JointCalibration, Twin

_OF_ITS_PROCESS = ("process:", "plugin:")
"""Layers of the process that ran a golden: what was added later cannot have changed its result."""
NO_RELEASE = Reason("no release yet")
_FIELDS_PER_PART = 4
"""Largest number of changed fields of a part that are listed."""
_UNIT = re.compile(r"(.*\S) \[([^\]]*)\]")
_IDENTITY = JointCalibration()


class Kind(Protocol):
    """Methods of a check that the dependency map needs."""

    @property
    def kind(self) -> str:
        """Name of the kind in specs."""
        ...

    @property
    def version(self) -> int:
        """Version number; it is increased when the same spec would give other results."""
        ...

    @property
    def libraries(self) -> tuple[str, ...]:
        """Python distributions whose version the results depend on."""
        ...

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Ids of the parts that the result of ``golden`` depends on."""
        ...


@dataclass(frozen=True, slots=True)
class Model:
    """Parts and structure of a realization.

    Attributes:
        parts: part id -> part.
        structure: its kinematic tree, actuators and couplings.
        replaced: part id -> part with the model's own values, where ``fit:`` replaces them.
    """

    parts: Mapping[str, Part]
    structure: Structure
    replaced: Mapping[str, Part] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DependencyMap:
    """Current parts of a twin, and the parts that each golden depends on.

    Attributes:
        parts: part id -> part.
        depends_on: ``golden@realization`` -> ids of the parts that its result depends on.
    """

    parts: Mapping[str, Part]
    depends_on: Mapping[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Baseline:
    """Parts and results of the last release.

    Attributes:
        number: number of the release.
        parts: part id -> part at that time.
        passed: ``golden@realization`` -> whether it passed.
        depended_on: ``golden@realization`` -> ids of the parts that its result depended on.
    """

    number: int
    parts: Mapping[str, Part]
    passed: Mapping[str, bool]
    depended_on: Mapping[str, frozenset[str]]


# -- dependencies of goldens


@dataclass(frozen=True, slots=True)
class Lookups:
    """Functions that look up checks, versions and file digests.

    Attributes:
        kind_of: name of a kind -> its check.
        version_of: distribution -> installed version, ``absent`` where there is none.
        file_digest: (golden, or None for ``twin.yaml``; reference as written) -> SHA-256 of the
            file's bytes; None where there is no such file.
    """

    kind_of: Callable[[str], Kind]
    version_of: Callable[[str], str]
    file_digest: Callable[[Golden | None, str], str | None]


def dependency_map(
    twin: Twin,
    goldens: Sequence[Golden],
    models: Mapping[str, Model],
    lookups: Lookups,
) -> DependencyMap:
    """Collect the current parts of a twin, and the parts that each golden depends on.

    The goldens of a realization that is not in ``models`` (it does not load) depend on a part
    that does not exist, so that they are stale.

    Args:
        models: realization -> its parts and structure.
        lookups: functions that look up checks, versions and file digests.
    """
    parts: dict[str, Part] = {}
    for model in models.values():
        parts.update(model.parts)
    parts.update(twin_parts(twin, lambda file: lookups.file_digest(None, file)))
    depends_on = {}
    for golden in goldens:
        kind = lookups.kind_of(golden.kind)
        own = set(_spec_parts(parts, golden, kind, lookups))
        for name in golden.realizations:
            if name not in models:
                depends_on[f"{golden.id}@{name}"] = frozenset(own | {f"{name}/model"})
                continue
            model = models[name]
            ids = own | {f"{name}/other", _simulator_part(parts, name, twin, lookups)}
            declared = frozenset(kind.depends(golden, model.structure))
            ids |= _expanded_ids(declared, parts, golden, lookups)
            ids |= {
                f"declared:{part.name}"
                for part in twin.parts.values()
                if _is_affected(part.affects, golden, ids, model.structure)
            }
            depends_on[f"{golden.id}@{name}"] = frozenset(ids)
    return DependencyMap(parts, depends_on)


def _simulator_part(parts: dict[str, Part], realization: str, twin: Twin, lookups: Lookups) -> str:
    simulator = twin.realizations[realization].simulator
    ident = f"simulator:{simulator}"
    if ident not in parts:
        parts[ident] = Part(ident, {"version": lookups.version_of(simulator)})
    return ident


def twin_parts(twin: Twin, file_digest: Callable[[str], str | None]) -> dict[str, Part]:
    """Parts that ``twin.yaml`` declares in addition to the model, by part id.

    Args:
        file_digest: path of a declared part's file -> SHA-256, None where there is no such file.
    """
    contents: dict[str, dict[str, Any]] = {
        "topics:recordings": {**twin.topics, **twin.recordings.to_json()},
        # Where any is declared, the name that a recording states must be declared.
        "variants:declared": {
            "controllers": bool(twin.controllers),
            "payloads": bool(twin.payloads),
        },
    }
    for name, actuators in twin.controllers.items():
        contents[f"controller:{name}"] = {a: dict(patch) for a, patch in actuators.items()}
    for name, bodies in twin.payloads.items():
        contents[f"payload:{name}"] = {
            body: {
                "mass [kg]": added.mass,
                "centre of mass [m]": list(added.com),
                "inertia [kg*m^2]": list(added.inertia),
            }
            for body, added in bodies.items()
        }
    if twin.calibration is not None:
        for joint, calibration in twin.calibration.joints.items():
            contents[f"calibration:{joint}"] = joint_calibration(calibration)
    pose = None if twin.calibration is None else twin.calibration.transform_world_to_base
    contents["base:calibration"] = (
        {}
        if pose is None
        else {"position [m]": list(pose.position), "quaternion": list(pose.quaternion)}
    )
    superseded = {name for entry in twin.calibrations for name in entry.supersedes}
    for entry in twin.calibrations:
        ident = entry.record.id
        contents[f"record:{ident}"] = {**_record(entry.record), "superseded": ident in superseded}
    superseded = {name for fit in twin.fits for name in fit.supersedes}
    for fit in twin.fits:
        contents[f"fit:{fit.record.id}"] = {
            **_identification(fit.record),
            "superseded": fit.record.id in superseded,
        }
    for record in twin.fits_in_use:
        for sensor in record.sensors:
            contents[f"sensor:{sensor.name}"] = asdict(sensor)
        for joint, step in record.encoder_steps.items():
            contents[f"encoder:{joint}"] = {"step [rad or m]": step}
    contents["accepted:findings"] = {
        finding: asdict(accepted) for finding, accepted in twin.accepted_findings.items()
    }
    for name, part in twin.parts.items():
        content: dict[str, Any] = {"id": part.id, "value": part.value}
        if part.file is not None:
            content["sha256"] = file_digest(str(part.file))
        contents[f"declared:{name}"] = {k: v for k, v in content.items() if v is not None}
    return {ident: Part(ident, content) for ident, content in contents.items()}


def joint_calibration(calibration: JointCalibration) -> dict[str, Any]:
    """Content of the part ``calibration:JOINT``."""
    scale = {} if calibration.scale == 1.0 else {"scale": calibration.scale}
    return {"offset [rad or m]": calibration.offset, "sign": calibration.sign, **scale}


def _record(record: CalibrationRecord) -> dict[str, Any]:
    """Estimates of a calibration, and digests of its input files."""
    return {
        "joint zeros [rad or m]": dict(record.joint_zeros),
        "transforms": {
            name: {"position [m]": list(xyz), "quaternion": None if turn is None else list(turn)}
            for name, (xyz, turn) in record.transforms.items()
        },
        "points": {f"{name} [m]": list(xyz) for name, xyz in record.points.items()},
        "data": dict(record.inputs),
    }


def _identification(record: IdentificationRecord) -> dict[str, Any]:
    """Estimates of an identification, and digests of its input files."""
    return {
        "parameters": dict(record.values),
        "stages": dict(record.stages),
        "data": dict(record.inputs),
    }


def _spec_parts(
    parts: dict[str, Part], golden: Golden, kind: Kind, lookups: Lookups
) -> Iterator[str]:
    """Ids of spec, trace, check and libraries of a golden; their parts are added to ``parts``."""
    own = f"spec:{golden.id}"
    # The list of realizations is left out, since each has its own result; so are title and author.
    parts[own] = Part(
        own,
        {
            "kind": golden.kind,
            "target": golden.target,
            "stimulus": golden.stimulus,
            "tolerance": {
                name: {f"bound [{bound.unit}]": bound.value}
                for name, bound in golden.tolerance.items()
            },
            "expected": golden.expected,
        },
    )
    yield own
    if golden.trace is not None:
        trace = f"trace:{golden.id}"
        # Digest of the file itself: the digest in the spec would hide a changed file.
        digest = lookups.file_digest(None, str(golden.path.parent / golden.trace.file))
        parts[trace] = Part(trace, {"sha256": digest or "absent"})
        yield trace
    check = f"check:{golden.kind}"
    if check not in parts:
        parts[check] = Part(check, {"version": kind.version})
    yield check
    for name in kind.libraries:
        library = f"library:{name}"
        if library not in parts:
            parts[library] = Part(library, {"version": lookups.version_of(name)})
        yield library


def _expanded_ids(
    declared: frozenset[str],
    parts: dict[str, Part],
    golden: Golden,
    lookups: Lookups,
) -> set[str]:
    """Ids with ``layer:*`` replaced by all parts of the layer; new parts are added to ``parts``."""
    ids = set(declared)
    for ident in declared:
        layer, _, name = ident.partition(":")
        if "/" in layer:
            continue
        if name == "*":
            ids.remove(ident)
            ids |= {known for known in parts if known.startswith(f"{layer}:")}
        elif layer == "calibration" and ident not in parts:
            parts[ident] = Part(ident, joint_calibration(_IDENTITY))
        elif layer == "library" and ident not in parts:
            parts[ident] = Part(ident, {"version": lookups.version_of(name)})
        elif layer in ("recording", "file") and ident not in parts:
            digest = lookups.file_digest(golden, name)
            if digest is not None:
                parts[ident] = Part(ident, {"sha256": digest})
        if layer == "recording":
            ids |= {"topics:recordings", "variants:declared", "base:calibration"}
    return ids


def _is_affected(
    affects: Affects | None, golden: Golden, ids: set[str], structure: Structure
) -> bool:
    if affects is None:
        return True
    if affects.kinds and golden.kind not in affects.kinds:
        return False
    if affects.goldens and not any(fnmatchcase(golden.id, pattern) for pattern in affects.goldens):
        return False
    return not affects.joints or any(
        _depends_on_joint(joint, ids, structure) for joint in affects.joints
    )


def _depends_on_joint(joint: str, ids: set[str], structure: Structure) -> bool:
    name = structure.realization
    parts_of_joint = {f"{name}/joint:{joint}", f"{name}/limit:{joint}", f"calibration:{joint}"}
    parts_of_joint |= {
        f"{name}/actuator:{actuator}"
        for actuator, joints in structure.actuator_joints.items()
        if joint in joints
    }
    if joint in structure.joint_body:
        parts_of_joint.add(f"{name}/kinematics:{structure.joint_body[joint]}")
    return not parts_of_joint.isdisjoint(ids)


def rule_problems(
    twin: Twin,
    goldens: Sequence[Golden],
    models: Mapping[str, Model],
    kinds: Iterable[str],
) -> list[SpecError]:
    """Errors for rules under ``parts:`` that match no golden.

    A spelling mistake in such a rule would leave a golden fresh that should be stale.
    """
    ids = [golden.id for golden in goldens]
    known_kinds = set(kinds)
    joints = {joint for model in models.values() for joint in model.structure.joint_body}
    problems = []
    for name, part in twin.parts.items():
        rule = part.affects or Affects()
        wrong = [("kinds", i, k) for i, k in enumerate(rule.kinds) if k not in known_kinds]
        wrong += [
            ("goldens", i, pattern)
            for i, pattern in enumerate(rule.goldens)
            if not any(fnmatchcase(ident, pattern) for ident in ids)
        ]
        if models:
            wrong += [("joints", i, j) for i, j in enumerate(rule.joints) if j not in joints]
        expected = {
            "kinds": "a kind of golden: " + ", ".join(sorted(known_kinds)),
            "goldens": "a pattern that matches ids of goldens, such as 'golden/contact/*'",
            "joints": "a joint of the model: " + ", ".join(sorted(joints)),
        }
        problems += [
            twin.error(
                f"parts.{name}.affects.{key}.{i}",
                "a rule that matches no golden",
                value=value,
                expected=expected[key],
            )
            for key, i, value in wrong
        ]
    return problems


# -- stale goldens


def staleness(current: DependencyMap, baseline: Baseline | None) -> dict[str, tuple[Reason, ...]]:
    """Map ``golden@realization`` to the reasons why it is stale; an empty tuple means fresh.

    Each part is compared once, so that the time is linear in the number of goldens.
    """
    absent = frozenset().union(*current.depends_on.values()) - current.parts.keys()

    def missing(ids: frozenset[str]) -> list[Reason]:
        return [Reason(ident, "is missing") for ident in sorted(ids & absent)]

    if baseline is None:
        return {key: (NO_RELEASE, *missing(ids)) for key, ids in current.depends_on.items()}
    changed = _ChangedParts(current.parts, baseline.parts)
    found = {}
    for key, ids in current.depends_on.items():
        before = baseline.depended_on.get(key)
        reasons: list[Reason] = []
        if before is None:
            reasons.append(Reason(f"not in release {baseline.number}"))
        elif not baseline.passed.get(key, False):
            reasons.append(Reason(f"failed in release {baseline.number}"))
        if before is not None:
            for ident in sorted(ids & changed.ids & before):
                reasons += changed.reasons(ident)
            added = {i for i in ids - before if not i.startswith(_OF_ITS_PROCESS)}
            reasons += [_set_change(ident, "added") for ident in sorted(added)]
            reasons += [_set_change(ident, "removed") for ident in sorted(before - ids)]
        found[key] = (*reasons, *missing(ids))
    return found


def _set_change(ident: str, what: str) -> Reason:
    return Reason(ident, f"dependency set changed: {what}")


@dataclass
class _ChangedParts:
    """Parts that differ from those of the baseline."""

    current: Mapping[str, Part]
    before: Mapping[str, Part]
    ids: set[str] = field(default_factory=set)
    _reasons: dict[str, tuple[Reason, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # A part that the release lacks counts as changed.
        self.ids = {
            ident
            for ident, part in self.current.items()
            if ident not in self.before or self.before[ident].digest != part.digest
        }

    def reasons(self, ident: str) -> tuple[Reason, ...]:
        if ident not in self._reasons:
            self._reasons[ident] = (
                tuple(changes(self.before[ident], self.current[ident]))
                if ident in self.before
                else (Reason(ident, "is new since the release"),)
            )
        return self._reasons[ident]


def changes(before: Part, after: Part) -> list[Reason]:
    """Differences between two versions of a part: field, old value, new value with unit.

    At most four fields are named.
    """
    old, new = dict(_leaves(before.content)), dict(_leaves(after.content))
    found = []
    for name in sorted(old.keys() | new.keys()):
        was, now = old.get(name), new.get(name)
        if name in old and name in new and canonical(was) == canonical(now):
            continue
        if [] in (was, now) and not (name in old and name in new):
            # An empty list became non-empty or the reverse; another entry names the element.
            continue
        match = _UNIT.fullmatch(name)
        title, unit = (match[1], f" {match[2]}") if match else (name, "")
        found.append(
            Reason(
                before.id,
                title,
                _format(was) if name in old else "absent",
                _format(now) + unit if name in new else "absent",
            )
        )
    if not found and before.digest != after.digest:
        found = [Reason(before.id, "content")]
    if len(found) > _FIELDS_PER_PART:
        rest = len(found) - _FIELDS_PER_PART
        found[_FIELDS_PER_PART:] = [Reason(before.id, f"and {rest} more fields")]
    return found


def _leaves(content: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of all leaves; a list of numbers is one leaf."""
    if isinstance(content, Mapping):
        unit = _UNIT.fullmatch(name)
        prefix = unit[1] if unit else name
        for key, value in content.items():
            yield from _leaves(value, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(content, list | tuple) and any(
        isinstance(item, Mapping | list | tuple) for item in content
    ):
        for index, value in enumerate(content):
            yield from _leaves(value, f"{name}.{_element_name(value, index)}")
    else:
        yield name, content


def _element_name(value: Any, index: int) -> str:
    """Name of an element of a list, or its index where it has none."""
    named = value.get("name") if isinstance(value, Mapping) else None
    return named if isinstance(named, str) else str(index)


def _format(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, int | float):
        return f"{value:.9g}"
    if isinstance(value, list | tuple):
        return (
            "["
            + ", ".join(_format(item) for item in value[:10])
            + (", ...]" if len(value) > 10 else "]")
        )
    text = str(value)
    return text[:12] if re.fullmatch(r"[0-9a-f]{64}", text) else text[:80]
