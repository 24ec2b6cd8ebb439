"""Read declared evidence about a robot, and compare it with the robot's file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.audit import simready
from pytest_twin.audit.asset import Asset, Joint, Vector
from pytest_twin.audit.finding import Finding, Place, finding_of
from pytest_twin.errors import SpecError
from pytest_twin.formats import yaml
from pytest_twin.formats.schema import load_schema, validate

_STEP = 1e-5
"""rad or m: step of the difference quotient for the direction in which a frame moves."""
_PLAIN = 0.3
"""Smallest cosine between motion and declared direction that determines the sign."""


@dataclass(frozen=True, slots=True)
class JointEvidence:
    """Declared evidence about one joint.

    Attributes:
        limits: (lower, upper) in rad or m; velocity: rad/s or m/s; effort: N*m or N.
        direction: frame, (3,) direction in the base, and name of the pose at which it holds.
        zero: description of the pose at which its encoder reads 0.
    """

    place: Place
    source: str
    limits: tuple[float, float] | None = None
    velocity: float | None = None
    effort: float | None = None
    direction: tuple[str, Vector, str | None] | None = None
    zero: str | None = None


@dataclass(frozen=True, slots=True)
class FrameEvidence:
    """A measured position of a frame: (3,) in the base frame, and its tolerance, m."""

    place: Place
    source: str
    frame: str
    pose: str | None
    position: Vector
    tolerance: float


@dataclass(frozen=True, slots=True)
class Evidence:
    """All declared evidence; empty by default.

    Attributes:
        mass: kg, tolerance in kg, source.
        commands: joint or actuator -> quantity of its command, with unit and source.
        poses: name -> joint -> rad or m.
        simready: results of NVIDIA's validator.
    """

    joints: Mapping[str, JointEvidence] = field(default_factory=dict)
    frames: tuple[FrameEvidence, ...] = ()
    commands: Mapping[str, str] = field(default_factory=dict)
    poses: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    mass: tuple[float, float, str] | None = None
    tcp: str | None = None
    simready: simready.SimReadyResults | None = None
    path: Path | None = None


def load(path: Path) -> Evidence:
    """Read an evidence file, or the JSON of ``simready-validate``.

    Raises:
        FormatError: not strict YAML, or not that JSON.
        SpecError: the file violates the schema, or refers to an undeclared pose.
    """
    if path.suffix.lower() == simready.SUFFIX:
        return Evidence(simready=simready.load(path), path=path)
    document = yaml.load(path)
    validate(document, load_schema("evidence.schema.json"), path)
    data, lines = document.data, document.lines
    common = data.get("source", path.name)
    poses = data.get("poses", {})

    def at(field_name: str) -> Place:
        return Place(path, lines.get(field_name))

    def pose(entry: Mapping[str, Any], where: str) -> str | None:
        name = entry.get("pose")
        if name is not None and name not in poses:
            raise SpecError(
                "no such pose",
                path=path,
                line=lines.get(f"{where}.pose"),
                where=f"{where}.pose",
                value=name,
                expected="one of: " + (", ".join(poses) or "none is declared under poses"),
            )
        return None if name is None else str(name)

    joints = {}
    for name, entry in data.get("joints", {}).items():
        where = f"joints.{name}"
        positive = entry.get("positive")
        limits = entry.get("range")
        joints[name] = JointEvidence(
            at(where),
            entry.get("source", common),
            None if limits is None else (float(limits[0]), float(limits[1])),
            entry.get("velocity"),
            entry.get("effort"),
            None
            if positive is None
            else (
                positive["frame"],
                np.array(positive["along"], dtype=np.float64),
                pose(positive, f"{where}.positive"),
            ),
            entry.get("zero"),
        )
    frames = tuple(
        FrameEvidence(
            at(f"frames.{index}"),
            entry.get("source", common),
            entry["frame"],
            pose(entry, f"frames.{index}"),
            np.array(entry["position"], dtype=np.float64),
            float(entry.get("tolerance", 1e-3)),
        )
        for index, entry in enumerate(data.get("frames", []))
    )
    commands = {
        name: f"{entry['means']} [{entry['unit']}] ({entry.get('source', common)})"
        for name, entry in data.get("commands", {}).items()
    }
    mass = data.get("mass")
    return Evidence(
        joints,
        frames,
        commands,
        {name: {j: float(v) for j, v in values.items()} for name, values in poses.items()},
        None
        if mass is None
        else (
            float(mass["value"]),
            float(mass.get("tolerance", 0.05 * mass["value"])),
            mass.get("source", common),
        ),
        data.get("tcp"),
        path=path,
    )


def check(asset: Asset, evidence: Evidence) -> Iterator[Finding]:
    """Yield contradictions between the file and the declared evidence."""
    for name, known in evidence.joints.items():
        joint = asset.joint.get(name)
        if joint is None:
            yield _unknown_name("joints.evidence_unused", known.place, f"joint '{name}'")
            continue
        yield from _numbers(joint, known)
        if known.direction is not None:
            yield from _direction(asset, joint, known, evidence)
    for measured in evidence.frames:
        yield from _frame(asset, measured, evidence)
    for name, values in evidence.poses.items():
        for joint_name in values:
            if joint_name not in asset.joint:
                yield _unknown_name(
                    "joints.evidence_unused",
                    Place(_path(evidence)),
                    f"joint '{joint_name}' of pose '{name}'",
                )
    if evidence.mass is not None:
        yield from _mass(asset, *evidence.mass)
    if evidence.simready is not None:
        yield from simready.check(asset, evidence.simready)


def frame_position(asset: Asset, frame: str, values: Mapping[str, float]) -> Vector | None:
    """Return the (3,) origin of a body or site in the base frame, m; None if it does not exist."""
    body, offset = frame, np.zeros(3)
    if frame in asset.sites:
        body, offset, _ = asset.sites[frame]
    found = asset.at(values).get(body)
    return None if found is None else found[0] + found[1] @ offset


def _path(evidence: Evidence) -> Path:
    return evidence.path or Path()


def _unknown_name(code: str, place: Place, element: str) -> Finding:
    return Finding(
        code,
        "warning",
        place,
        element,
        "the evidence names something that the asset does not have",
        None,
        None,
        "a name of the asset",
        "evidence under a wrong name is not used",
        "correct the name in the evidence file",
    )


def _numbers(joint: Joint, known: JointEvidence) -> Iterator[Finding]:
    said = f"as declared by {known.source}"
    element = f"joint '{joint.name}'"
    if known.limits is not None and joint.lower is not None and joint.upper is not None:
        off = max(abs(joint.lower - known.limits[0]), abs(joint.upper - known.limits[1]))
        beyond = joint.lower < known.limits[0] - 1e-3 or joint.upper > known.limits[1] + 1e-3
        if off > 1e-3:
            yield finding_of(
                "joints.range_contradicted",
                joint.place,
                element,
                f"{joint.lower:.5g} .. {joint.upper:.5g}",
                severity="critical" if beyond else "warning",
                title="its range is wider than the declared one"
                if beyond
                else "its range is narrower than the declared one",
                unit=joint.unit,
                expected=f"{known.limits[0]:.5g} .. {known.limits[1]:.5g}, {said}",
                why="a motion that passes in simulation hits a stop of the real robot"
                if beyond
                else "motions that the robot can make are refused",
            )
    for name, value, declared, unit in (
        ("velocity", joint.velocity, known.velocity, f"{joint.unit}/s"),
        ("effort", joint.effort, known.effort, joint.effort_unit),
    ):
        if value and declared and abs(value - declared) > 0.01 * declared:
            yield Finding(
                f"joints.{name}_contradicted",
                "critical" if value > declared else "warning",
                joint.place,
                element,
                f"its {name} limit differs from the declared one",
                value,
                unit,
                f"{declared:g}, {said}",
                "plans are too optimistic where the simulated drive is stronger than the real one",
                "state the limit from the drive's data sheet",
            )


def _direction(
    asset: Asset, joint: Joint, known: JointEvidence, evidence: Evidence
) -> Iterator[Finding]:
    assert known.direction is not None
    frame, along, pose = known.direction
    values = dict(evidence.poses.get(pose, {})) if pose is not None else {}
    here = values.get(joint.name, joint.reference)
    before = frame_position(asset, frame, values | {joint.name: here - _STEP})
    after = frame_position(asset, frame, values | {joint.name: here + _STEP})
    element = f"joint '{joint.name}'"
    if before is None or after is None:
        yield _unknown_name("joints.evidence_unused", known.place, f"frame '{frame}' of {element}")
        return
    speed = (after - before) / (2 * _STEP)
    norm = float(np.linalg.norm(speed) * np.linalg.norm(along))
    cosine = float(speed @ along) / norm if norm > 1e-9 else 0.0
    if abs(cosine) < _PLAIN:
        yield finding_of(
            "joints.sign_unclear",
            known.place,
            element,
            cosine,
            title="the declared direction does not determine the sign: "
            f"'{frame}' moves almost across it",
            expected=f"a cosine of at least {_PLAIN:g} between motion and declared direction",
        )
    elif cosine < 0:
        yield finding_of(
            "joints.sign_contradicted",
            joint.place,
            element,
            cosine,
            title=f"a positive step moves '{frame}' against the declared direction",
            expected=f"a positive cosine, as declared by {known.source}",
        )


def _frame(asset: Asset, measured: FrameEvidence, evidence: Evidence) -> Iterator[Finding]:
    values = evidence.poses.get(measured.pose, {}) if measured.pose is not None else {}
    found = frame_position(asset, measured.frame, values)
    element = f"frame '{measured.frame}'"
    if found is None:
        yield _unknown_name("frames.evidence_unused", measured.place, element)
        return
    off = float(np.linalg.norm(found - measured.position))
    if off > measured.tolerance:
        pose = "as drawn" if measured.pose is None else f"at pose '{measured.pose}'"
        place = asset.body[measured.frame].place if measured.frame in asset.body else measured.place
        yield finding_of(
            "frames.position_contradicted",
            place,
            element,
            off,
            title=f"{pose}, it is not at its measured position",
            expected=f"within {measured.tolerance:g} m of "
            + " ".join(f"{v:.5g}" for v in measured.position)
            + f", {measured.source}",
        )


def _mass(asset: Asset, value: float, tolerance: float, source: str) -> Iterator[Finding]:
    total = sum(body.mass or 0.0 for body in asset.bodies)
    if abs(total - value) > tolerance:
        yield finding_of(
            "inertia.mass_contradicted",
            asset.place,
            f"robot '{asset.name}'",
            total,
            expected=f"{value:g} kg within {tolerance:g} kg, {source}",
        )
