"""What every golden depends on today, and which of them a change has made stale. Pure."""

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

NO_RELEASE = Reason("no release yet")
_FIELDS_PER_PART = 4
_UNIT = re.compile(r"(.*\S) \[([^\]]*)\]")
_IDENTITY = JointCalibration()


class Kind(Protocol):
    """Methods of a check that the dependency map needs."""

    @property
    def kind(self) -> str:
        """Its name in specs."""
        ...

    @property
    def version(self) -> int:
        """Raised when the same spec would give other numbers."""
        ...

    @property
    def libraries(self) -> tuple[str, ...]:
        """Distributions whose version its results depend on."""
        ...

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Ids of the parts that can move its result."""
        ...


@dataclass(frozen=True, slots=True)
class Model:
    """One realization of today.

    Attributes:
        parts: its parts, by id.
        structure: how it hangs together.
    """

    parts: Mapping[str, Part]
    structure: Structure


@dataclass(frozen=True, slots=True)
class Stock:
    """What there is today.

    Attributes:
        parts: part id -> part.
        rests_on: ``golden@realization`` -> ids of all that its result depends on.
    """

    parts: Mapping[str, Part]
    rests_on: Mapping[str, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Baseline:
    """What the last release vouches for.

    Attributes:
        number: the release.
        parts: part id -> part, as it was.
        passed: ``golden@realization`` -> whether it passed.
        rested_on: ``golden@realization`` -> ids of all that its result rested on.
    """

    number: int
    parts: Mapping[str, Part]
    passed: Mapping[str, bool]
    rested_on: Mapping[str, frozenset[str]]


# -- what a golden depends on


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Facts from outside the files.

    Attributes:
        kind_of: name of a kind -> its check.
        version_of: distribution -> installed version, ``absent`` where there is none.
        file_digest: (golden, or None for ``twin.yaml``; reference as written) -> SHA-256 of the
            file's bytes; None where there is no such file.
    """

    kind_of: Callable[[str], Kind]
    version_of: Callable[[str], str]
    file_digest: Callable[[Golden | None, str], str | None]


def take_stock(
    twin: Twin,
    goldens: Sequence[Golden],
    models: Mapping[str, Model],
    surroundings: Surroundings,
) -> Stock:
    """All parts of today, and what each golden depends on.

    A realization that is not in ``models`` (it does not load) leaves its goldens with an id that
    no part bears, so that they are stale.

    Args:
        twin: the twin.
        goldens: its goldens.
        models: realization -> what it consists of.
        surroundings: versions, checks and files.
    """
    parts: dict[str, Part] = {}
    for model in models.values():
        parts.update(model.parts)
    parts.update(twin_parts(twin, lambda file: surroundings.file_digest(None, file)))
    rests_on = {}
    for golden in goldens:
        kind = surroundings.kind_of(golden.kind)
        around = set(_own_parts(parts, golden, kind, surroundings))
        for name in golden.realizations:
            if name not in models:
                rests_on[f"{golden.id}@{name}"] = frozenset(around | {f"{name}/model"})
                continue
            model = models[name]
            ids = around | {f"{name}/other", _version_part(parts, name, twin, surroundings)}
            felt = frozenset(kind.depends(golden, model.structure))
            ids |= _resolved(felt, parts, golden, twin, surroundings)
            ids |= {
                f"declared:{part.name}"
                for part in twin.parts.values()
                if _affected(part.affects, golden, ids, model.structure)
            }
            rests_on[f"{golden.id}@{name}"] = frozenset(ids)
    return Stock(parts, rests_on)


def _version_part(
    parts: dict[str, Part], realization: str, twin: Twin, surroundings: Surroundings
) -> str:
    simulator = twin.realizations[realization].simulator
    ident = f"simulator:{simulator}"
    if ident not in parts:
        parts[ident] = Part(ident, {"version": surroundings.version_of(simulator)})
    return ident


def twin_parts(twin: Twin, file_digest: Callable[[str], str | None]) -> dict[str, Part]:
    """What ``twin.yaml`` states beside the model, by part id.

    Args:
        twin: the twin.
        file_digest: path of a declared part's file -> SHA-256, None where there is no such file.
    """
    contents: dict[str, dict[str, Any]] = {
        "topics:recordings": {**twin.topics, **twin.recordings.to_json()},
        # With any declared, a recording has to name its own.
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
            contents[f"calibration:{joint}"] = _calibration(calibration)
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
            **_identified(fit.record),
            "superseded": fit.record.id in superseded,
        }
    for record in twin.holding_fits:
        for sensor in record.sensors:
            contents[f"sensor:{sensor.name}"] = asdict(sensor)
        for joint, step in record.encoder_steps.items():
            contents[f"encoder:{joint}"] = {"step [rad or m]": step}
    for name, part in twin.parts.items():
        content: dict[str, Any] = {"id": part.id, "value": part.value}
        if part.file is not None:
            content["sha256"] = file_digest(str(part.file))
        contents[f"declared:{name}"] = {k: v for k, v in content.items() if v is not None}
    return {ident: Part(ident, content) for ident, content in contents.items()}


def _calibration(calibration: JointCalibration) -> dict[str, Any]:
    scale = {} if calibration.scale == 1.0 else {"scale": calibration.scale}
    return {"offset [rad or m]": calibration.offset, "sign": calibration.sign, **scale}


def _record(record: CalibrationRecord) -> dict[str, Any]:
    """What a calibration estimated, and the files that it was made from."""
    return {
        "joint zeros [rad or m]": dict(record.joint_zeros),
        "transforms": {
            name: {"position [m]": list(xyz), "quaternion": None if turn is None else list(turn)}
            for name, (xyz, turn) in record.transforms.items()
        },
        "points": {f"{name} [m]": list(xyz) for name, xyz in record.points.items()},
        "data": dict(record.inputs),
    }


def _identified(record: IdentificationRecord) -> dict[str, Any]:
    """What an identification found, and the files that it was made from."""
    return {
        "parameters": dict(record.values),
        "stages": dict(record.stages),
        "data": dict(record.inputs),
    }


def _own_parts(
    parts: dict[str, Part], golden: Golden, kind: Kind, surroundings: Surroundings
) -> Iterator[str]:
    """Ids of what a golden brings along; the parts are put into ``parts``."""
    own = f"spec:{golden.id}"
    # Not the realizations: each is proven by itself. Not the title, nor who recorded it.
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
        # Of the file as it lies there: that the spec names the right digest is not enough.
        digest = surroundings.file_digest(None, str(golden.path.parent / golden.trace.file))
        parts[trace] = Part(trace, {"sha256": digest or "absent"})
        yield trace
    check = f"check:{golden.kind}"
    if check not in parts:
        parts[check] = Part(check, {"version": kind.version})
    yield check
    for name in kind.libraries:
        library = f"library:{name}"
        if library not in parts:
            parts[library] = Part(library, {"version": surroundings.version_of(name)})
        yield library


def _resolved(
    felt: frozenset[str],
    parts: dict[str, Part],
    golden: Golden,
    twin: Twin,
    surroundings: Surroundings,
) -> set[str]:
    """Ids as they are, with every ``controller:*`` written out, and files digested."""
    ids = set(felt)
    for ident in felt:
        layer, _, name = ident.partition(":")
        if "/" in layer:
            continue
        if name == "*":
            ids.remove(ident)
            ids |= {known for known in parts if known.startswith(f"{layer}:")}
        elif layer == "calibration" and ident not in parts:
            parts[ident] = Part(ident, _calibration(_IDENTITY))
        elif layer == "library" and ident not in parts:
            parts[ident] = Part(ident, {"version": surroundings.version_of(name)})
        elif layer in ("recording", "file") and ident not in parts:
            digest = surroundings.file_digest(golden, name)
            if digest is not None:
                parts[ident] = Part(ident, {"sha256": digest})
        if layer == "recording":
            ids |= {"topics:recordings", "variants:declared", "base:calibration"}
    return ids


def _affected(affects: Affects | None, golden: Golden, ids: set[str], structure: Structure) -> bool:
    if affects is None:
        return True
    if affects.kinds and golden.kind not in affects.kinds:
        return False
    if affects.goldens and not any(fnmatchcase(golden.id, pattern) for pattern in affects.goldens):
        return False
    return not affects.joints or any(_feels(joint, ids, structure) for joint in affects.joints)


def _feels(joint: str, ids: set[str], structure: Structure) -> bool:
    name = structure.realization
    signs = {f"{name}/joint:{joint}", f"{name}/limit:{joint}", f"calibration:{joint}"}
    signs |= {
        f"{name}/actuator:{actuator}"
        for actuator, joints in structure.actuator_joints.items()
        if joint in joints
    }
    if joint in structure.joint_body:
        signs.add(f"{name}/kinematics:{structure.joint_body[joint]}")
    return not signs.isdisjoint(ids)


def rule_problems(
    twin: Twin,
    goldens: Sequence[Golden],
    models: Mapping[str, Model],
    kinds: Iterable[str],
) -> list[SpecError]:
    """Rules of ``parts:`` that touch nothing: a slip of the pen would keep a golden fresh."""
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
            "goldens": "a pattern over ids of goldens that are there, such as 'golden/contact/*'",
            "joints": "a joint of the model: " + ", ".join(sorted(joints)),
        }
        problems += [
            twin.error(
                f"parts.{name}.affects.{key}.{i}",
                "a rule that touches no golden",
                value=value,
                expected=expected[key],
            )
            for key, i, value in wrong
        ]
    return problems


# -- what is stale


def staleness(today: Stock, baseline: Baseline | None) -> dict[str, tuple[Reason, ...]]:
    """``golden@realization`` -> why it is stale; empty where the baseline still proves it.

    Linear in the number of goldens: every part is compared once.
    """
    absent = frozenset().union(*today.rests_on.values()) - today.parts.keys()

    def missing(ids: frozenset[str]) -> list[Reason]:
        return [Reason(ident, "is missing") for ident in sorted(ids & absent)]

    if baseline is None:
        return {key: (NO_RELEASE, *missing(ids)) for key, ids in today.rests_on.items()}
    moved = _Moved(today.parts, baseline.parts)
    found = {}
    for key, ids in today.rests_on.items():
        before = baseline.rested_on.get(key)
        reasons: list[Reason] = []
        if before is None:
            reasons.append(Reason(f"not in release {baseline.number}"))
        elif not baseline.passed.get(key, False):
            reasons.append(Reason(f"failed in release {baseline.number}"))
        if before is not None:
            for ident in sorted(ids & moved.ids & before):
                reasons += moved.reasons(ident)
            if ids != before:
                reasons += [_set_change(ident, "added") for ident in sorted(ids - before)]
                reasons += [_set_change(ident, "removed") for ident in sorted(before - ids)]
        found[key] = (*reasons, *missing(ids))
    return found


def _set_change(ident: str, what: str) -> Reason:
    return Reason(ident, f"dependency set changed: {what}")


@dataclass
class _Moved:
    """Parts that are not what they were."""

    today: Mapping[str, Part]
    before: Mapping[str, Part]
    ids: set[str] = field(default_factory=set)
    _reasons: dict[str, tuple[Reason, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # A part that the release does not know cannot be told to be the same.
        self.ids = {
            ident
            for ident, part in self.today.items()
            if ident not in self.before or self.before[ident].digest != part.digest
        }

    def reasons(self, ident: str) -> tuple[Reason, ...]:
        if ident not in self._reasons:
            self._reasons[ident] = (
                tuple(changes(self.before[ident], self.today[ident]))
                if ident in self.before
                else (Reason(ident, "is new since the release"),)
            )
        return self._reasons[ident]


def changes(before: Part, after: Part) -> list[Reason]:
    """What differs between two contents of one part, field by field, with units.

    At most four fields are named.
    """
    old, new = dict(_leaves(before.content)), dict(_leaves(after.content))
    found = []
    for name in sorted(old.keys() | new.keys()):
        was, now = old.get(name), new.get(name)
        if name in old and name in new and canonical(was) == canonical(now):
            continue
        if [] in (was, now) and not (name in old and name in new):
            # A list that got its first element, or lost its last: the element is named.
            continue
        match = _UNIT.fullmatch(name)
        title, unit = (match[1], f" {match[2]}") if match else (name, "")
        found.append(
            Reason(
                before.id,
                title,
                _shown(was) if name in old else "absent",
                _shown(now) + unit if name in new else "absent",
            )
        )
    if not found and before.digest != after.digest:
        found = [Reason(before.id, "content")]
    if len(found) > _FIELDS_PER_PART:
        rest = len(found) - _FIELDS_PER_PART
        found[_FIELDS_PER_PART:] = [Reason(before.id, f"and {rest} more fields")]
    return found


def _leaves(content: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name -> value; a short list of numbers is one value."""
    if isinstance(content, Mapping):
        unit = _UNIT.fullmatch(name)
        prefix = unit[1] if unit else name
        for key, value in content.items():
            yield from _leaves(value, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(content, list | tuple) and any(
        isinstance(item, Mapping | list | tuple) for item in content
    ):
        for index, value in enumerate(content):
            yield from _leaves(value, f"{name}.{_label(value, index)}")
    else:
        yield name, content


def _label(value: Any, index: int) -> str:
    """What people call an element of a list: its name, else its place."""
    named = value.get("name") if isinstance(value, Mapping) else None
    return named if isinstance(named, str) else str(index)


def _shown(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, int | float):
        return f"{value:.9g}"
    if isinstance(value, list | tuple):
        return (
            "["
            + ", ".join(_shown(item) for item in value[:10])
            + (", ...]" if len(value) > 10 else "]")
        )
    text = str(value)
    return text[:12] if re.fullmatch(r"[0-9a-f]{64}", text) else text[:80]
