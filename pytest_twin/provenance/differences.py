"""Changes between a released and the present twin, and whether they affect a data set.

This module runs in the child process and loads both models. Changes are rated as follows:

- Geometry (joint zeros, link poses, base, tool frame): displacement of the tool centre point at the
  joint positions of the data set.
- Dynamics (inertia, friction, drives, contacts, controllers): difference of simulated joint
  positions under the commands of the data set.
- A change that the kinematic chain of the data set does not depend on has no effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.dependency import Part
from pytest_twin.errors import TwinError
from pytest_twin.formats.digest import file_sha256
from pytest_twin.formats.recording import Recording
from pytest_twin.outcome import Reason
from pytest_twin.provenance.displacement import Displacement, displacement_between, tool_poses
from pytest_twin.provenance.motion_difference import motion_differences
from pytest_twin.provenance.poses import (
    Poses,
    draw_poses,
    first_seconds,
    joints_of,
    poses_of,
    recordings_of,
    variants_of,
)
from pytest_twin.realization import Realization, load
from pytest_twin.realization.encoders import Encoders, calibration_of
from pytest_twin.realization.record_inputs import replaced_parts, states_of_records
from pytest_twin.recording_options import JointNames
from pytest_twin.records.state import RecordState, is_source_part, source_part
from pytest_twin.staleness import changes, twin_parts
from pytest_twin.twin import FreshPolicy, JointCalibration, Twin, load_twin

GEOMETRY = ("kinematics", "frame", "coupling", "base", "tcp", "calibration")
"""Layers of parts that determine the geometry."""
WITHOUT_EFFECT = ("keyframe", "sensor", "record", "variants", "geom")
"""Layers that change neither geometry nor motion."""
NOT_MODELLED = ("topics", "declared")
"""Layers whose effect on data cannot be computed from a model."""
_REPLAYED_SECONDS = 30.0
"""Length of the simulated part of recordings, which limits the computing time."""
_BEYOND = 0.1
"""Part of a joint's range by which encoders and stops may exceed it."""
_TCP = "tcp:frame"


@dataclass(frozen=True, slots=True)
class Version:
    """A version of a twin.

    Attributes:
        realization: its first realization.
        parts: part id -> part, of the realization and of ``twin.yaml``.
        frame: tool centre point: ``tcp:`` of ``twin.yaml``, or the last moving body.
        records: its records, with the changes of their inputs.
    """

    twin: Twin
    realization: Realization
    parts: Mapping[str, Part]
    frame: str
    records: Mapping[str, RecordState]

    @classmethod
    def of(cls, file: Path) -> Version:
        """Load a ``twin.yaml`` and its first realization.

        Raises:
            TwinError: it does not load.
        """
        twin = load_twin(file)
        name, reference = next(iter(twin.realizations.items()))
        realization = load(reference.file, twin=twin, name=name)
        structure = realization.structure
        deepest = max(structure.body_tree, key=lambda b: len(structure.ancestors(b)), default="")
        frame = twin.tcp or deepest
        parts = {**realization.parts, **twin_parts(twin, _digest)}
        parts[_TCP] = Part(_TCP, {"name": frame})
        records = {state.part.id: state for state in states_of_records(twin)}
        # A record whose inputs are unchanged has no part of its own.
        parts.update({i: state.part for i, state in records.items() if state.part.content})
        for part in replaced_parts(realization).values():
            source = source_part(part)
            parts[source.id] = source
        return cls(twin, realization, parts, frame, records)


def _digest(file: str) -> str | None:
    try:
        return file_sha256(Path(file))
    except TwinError:
        return None


def differences(
    before: str,
    today: str,
    dataset: str,
    stamped: Mapping[str, Sequence[str]],
    joints: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """All changes between two versions of a twin, with their size and their effect on a data set.

    Args:
        before, today: ``twin.yaml`` of the released and the present version.
        dataset: data set or policy that was made with the released version.
        stamped: ``controller`` and ``payload`` -> names in its stamps.
        joints: mapping from joint names of the data to the released ones, as in the stamp.

    Returns:
        JSON-able: ``changes``, ``tcp``, ``moved`` (m, rad), ``poses``, ``tolerance``, ``verdict``
        (``stale`` or ``fresh``) and ``notes``.

    Raises:
        TwinError: a version does not load, or the data set is damaged.
    """
    old, new = Version.of(Path(before)), Version.of(Path(today))
    stated = {part: names[0] for part, names in stamped.items() if len(names) == 1}
    recordings = [
        replace(recording, metadata={**stated, **recording.metadata})
        for recording in recordings_of(
            Path(dataset),
            new.twin,
            JointNames.of(joints or {}),
            old.realization.structure.joint_type,
        )
    ]
    poses = poses_of(recordings, new.realization.structure, new.twin)
    shown = poses or draw_poses(new.realization.structure)
    known = _common_joints(shown, old, new)
    changed = {
        ident: _reasons(ident, old.parts, new.parts)
        for ident in sorted(old.parts.keys() | new.parts.keys())
        if _digest_of(old.parts, ident) != _digest_of(new.parts, ident)
    }
    used = {part: names | set(stamped[part]) for part, names in variants_of(recordings).items()}
    judged = _Differences(old, new, recordings, used, known, changed, new.twin.fresh)
    listed = [judged.change(ident, reasons) for ident, reasons in changed.items()]
    total = judged.total()
    return {
        "changes": listed,
        "tcp": new.frame,
        "moved": None if total is None else total.to_json(),
        "poses": {"count": len(known.positions), "source": known.source},
        "tolerance": {
            "translation": new.twin.fresh.translation,
            "rotation": new.twin.fresh.rotation,
        },
        "verdict": "stale" if any(one["matters"] for one in listed) else "fresh",
        "notes": [*_notes_on_ranges(poses, old.realization), *judged.notes],
    }


def _notes_on_ranges(poses: Poses | None, released: Realization) -> list[str]:
    """A note for each joint whose recorded positions lie far beyond its released range.

    Joints of different robots may have the same names, such as ``joint1``.
    """
    notes: list[str] = []
    if poses is None:
        return notes
    ranges = released.structure.joint_range
    encoders = Encoders.of(calibration_of(released), poses.joints)
    for joint, column in zip(poses.joints, encoders.model_position(poses.positions).T, strict=True):
        span = ranges.get(joint)
        if span is None:
            continue
        low, high = span
        spare = _BEYOND * (high - low)
        share = float(np.mean((column < low - spare) | (column > high + spare)))
        if share > 0.0:
            notes.append(
                f"{joint}: {100.0 * share:.0f} % of the recorded positions lie far beyond the "
                f"released range of {low:.3g} to {high:.3g}: data of another robot, or in another "
                "unit?"
            )
    return notes


def _digest_of(parts: Mapping[str, Part], ident: str) -> str | None:
    return parts[ident].digest if ident in parts else None


def _reasons(ident: str, old: Mapping[str, Part], new: Mapping[str, Part]) -> list[Reason]:
    if ident in old and ident in new:
        return changes(old[ident], new[ident])
    return [Reason(ident, "is new" if ident in new else "is gone")]


def _common_joints(poses: Poses, old: Version, new: Version) -> Poses:
    """Poses, reduced to the joints that both versions have."""
    joints = [
        j
        for j in poses.joints
        if j in old.realization.structure.joint_type and j in new.realization.structure.joint_type
    ]
    columns = [poses.joints.index(joint) for joint in joints]
    return replace(poses, joints=tuple(joints), positions=poses.positions[:, columns])


class _Differences:
    """Computes the sizes of changes; each is computed once."""

    def __init__(
        self,
        old: Version,
        new: Version,
        recordings: Sequence[Recording],
        variants: Mapping[str, set[str]],
        poses: Poses,
        changed: Mapping[str, Sequence[Reason]],
        tolerance: FreshPolicy,
    ) -> None:
        self.old, self.new, self.poses, self.tolerance = old, new, poses, tolerance
        self.recordings, self.changed = recordings, changed
        self.variants = variants
        self.notes: list[str] = []
        self._simulated: dict[str, float] | None = None
        self._before: FloatArray | None = None
        self._geometry: Displacement | None = None
        structures = (old.realization.structure, new.realization.structure)
        frames = (old.frame, new.frame)
        self.chain = frozenset().union(
            *(s.chain([f]) for s, f in zip(structures, frames, strict=True))
        )
        self.dynamics = frozenset().union(
            *(s.dynamics(poses.joints) | s.effects() for s in structures)
        )

    # -- one change

    def change(self, ident: str, reasons: Sequence[Reason]) -> dict[str, Any]:
        """Description, size and effect of one changed part, JSON-able."""
        layer, _, name = ident.partition(":")
        layer = layer.rpartition("/")[2]
        size: dict[str, Any] | None = None
        if layer == "basis":
            matters, why, reasons = self._effect_of_record(ident, reasons)
        elif is_source_part(ident):
            matters, why = False, "fit: replaces these values"
        elif layer in WITHOUT_EFFECT:
            matters, why = False, "it changes neither geometry nor motion"
        elif layer in NOT_MODELLED:
            matters, why = True, "no model shows its effect on this data"
        elif layer in ("controller", "payload") and self._is_unused(layer, name):
            matters, why = False, f"no recording of this data names this {layer}"
        elif layer == "joint" and self._is_lost(ident, name):
            matters, why = True, "the data may use this joint, and only one version has it"
        elif layer == "calibration":
            found = self._zero(name)
            size = None if found is None else found.to_json()
            matters, why = self._effect_of_displacement(found, self._zero_in_words(name))
        elif layer in GEOMETRY:
            if ident in self.chain or layer in ("base", "tcp"):
                found = self.geometry()
                size = found.to_json()
                matters, why = self._effect_of_displacement(found, "the pose of links has changed")
            elif ident in self.dynamics:
                matters, why, size = self._effect_on_motion()
            else:
                matters, why = False, f"it is not on the chain to {self.new.frame!r}"
        elif ident in self.dynamics or layer in ("controller", "payload"):
            matters, why, size = self._effect_on_motion()
        else:
            matters, why = False, "nothing that this data's joints move depends on it"
        return {
            "part": ident,
            "changed": [
                {"field": reason.field, "old": reason.old, "new": reason.new} for reason in reasons
            ],
            "matters": matters,
            "why": why,
            "size": size,
        }

    def _effect_of_record(
        self, ident: str, reasons: Sequence[Reason]
    ) -> tuple[bool, str, Sequence[Reason]]:
        state = self.new.records.get(ident)
        if state is None or not state.changes:
            return False, "the record replaces these values", reasons
        reasons = [
            replace(reason, field=f"{reason.part}: {reason.field}")
            for change in state.changes
            for reason in change.reasons
        ]
        if state.touching:
            why = f"record {state.record.id!r} is stale: its values are of the robot before"
            return True, why, reasons
        stated = "; ".join(
            f"{change.accepted.owner}: {change.accepted.reason}"
            for change in state.changes
            if change.accepted is not None
        )
        return False, f"stated not to touch record {state.record.id!r}: {stated}", reasons

    def _is_lost(self, ident: str, joint: str) -> bool:
        """Whether only one version has a joint, and the data name it or name no joints."""
        named = {name for one in self.recordings for name in joints_of(one, self.new.twin)}
        in_both = ident in self.old.parts and ident in self.new.parts
        return not in_both and (joint in named or not named)

    def _is_unused(self, layer: str, name: str) -> bool:
        named = self.variants[layer]
        return bool(self.recordings or named) and name not in named

    def _effect_of_displacement(self, found: Displacement | None, what: str) -> tuple[bool, str]:
        if found is None:
            return False, "this data does not contain that joint"
        matters = (
            found.translation > self.tolerance.translation
            or found.rotation > self.tolerance.rotation
        )
        words = (
            f"{what}: {self.new.frame!r} moves by up to {1e3 * found.translation:.3g} mm and "
            f"{1e3 * found.rotation:.3g} mrad {self.poses.source}"
        )
        return matters, words

    def _effect_on_motion(self) -> tuple[bool, str, dict[str, Any] | None]:
        found = self.simulated()
        if found is None:
            return (
                True,
                "the dynamics have changed, and this data cannot be replayed",
                None,
            )
        worst = max(found, key=lambda joint: found[joint] / self._bound(joint))
        slide = self.new.realization.structure.joint_type[worst] == "slide"
        value = f"{1e3 * found[worst]:.3g} {'mm' if slide else 'mrad'}"
        words = (
            f"under this data's commands the simulated joint {worst!r} moves differently by up to "
            f"{value} (all such changes together)"
        )
        matters = found[worst] > self._bound(worst)
        return matters, words, {"joint": worst, "position": found[worst]}

    def _bound(self, joint: str) -> float:
        slide = self.new.realization.structure.joint_type[joint] == "slide"
        return self.tolerance.translation if slide else self.tolerance.rotation

    # -- sizes

    def before(self) -> FloatArray:
        """(n, 7) poses of the tool in the released version."""
        if self._before is None:
            old = self.old
            self._before = tool_poses(
                old.realization, old.frame, calibration_of(old.realization), self.poses
            )
        return self._before

    def _zero_in_words(self, joint: str) -> str:
        was, now = (
            calibration_of(version.realization).get(joint, JointCalibration())
            for version in (self.old, self.new)
        )
        slide = self.new.realization.structure.joint_type.get(joint) == "slide"
        if was.sign != now.sign:
            return f"the direction of joint {joint!r} was reversed"
        if was.scale != now.scale:
            percent = 100.0 * (now.scale / was.scale - 1.0)
            return f"the scale of the encoder of joint {joint!r} changed by {percent:+.3g} %"
        return f"the zero of joint {joint!r} moved by {abs(now.offset - was.offset):.4g} " + (
            "m" if slide else "rad"
        )

    def _zero(self, joint: str) -> Displacement | None:
        """Displacement by the changed calibration of a joint; None if it is not in the data."""
        if joint not in self.poses.joints:
            return None
        old = self.old.realization
        one = dict(calibration_of(old))
        now = calibration_of(self.new.realization)
        one.pop(joint, None)
        if joint in now:
            one[joint] = now[joint]
        return displacement_between(self.before(), tool_poses(old, self.old.frame, one, self.poses))

    def geometry(self) -> Displacement:
        """Displacement by all changes of geometry except the calibration of joints."""
        if self._geometry is None:
            new = self.new
            before = calibration_of(self.old.realization)
            after = tool_poses(new.realization, new.frame, before, self.poses)
            self._geometry = displacement_between(self.before(), after)
        return self._geometry

    def total(self) -> Displacement | None:
        """Displacement by all changes together; None where the geometry has not changed."""
        layers = {ident.partition(":")[0].rpartition("/")[2] for ident in self.changed}
        if layers.isdisjoint(GEOMETRY) or not self.poses.joints:
            return None
        new = self.new
        after = tool_poses(new.realization, new.frame, calibration_of(new.realization), self.poses)
        return displacement_between(self.before(), after)

    def simulated(self) -> dict[str, float] | None:
        """Joint -> largest difference between replays of both versions, rad or m; or None."""
        if self._simulated is None:
            part = first_seconds(self.recordings, _REPLAYED_SECONDS)
            self._simulated, notes = motion_differences(
                self.old.realization, self.new.realization, part
            )
            self.notes += notes
        return self._simulated or None
