"""What a calibration leaves uncertain, as unknowns that move the task's frame.

All unknowns of one record are one cause: they were estimated together, and their covariance says
how they vary together. Unknowns that the twin does not take over are left out, which is their
marginal distribution.

A frame is moved as follows. The base's pose in the world moves the whole robot. Joint zeros and
deviations of links move the frame through the chain. What the flange carries (tool, camera) moves
the frame about that place: for a camera, where an object at the frame is seen. So does what stands
in the base (camera, fixture).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.categories import category_of_record
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import ChainParameters, LinkParameter, forward
from pytest_twin.calibration.closed_form import inverse, rigid
from pytest_twin.calibration.parameters import POSE_LABELS
from pytest_twin.calibration.records import inverse_with_covariance
from pytest_twin.calibration.tangent import Moving, left_jacobian
from pytest_twin.errors import TwinError
from pytest_twin.formats.calibration_record import CalibrationRecord
from pytest_twin.metrics.pose import rotation_of
from pytest_twin.realization.serial_chain import load_serial_chain
from pytest_twin.twin import CalibrationEntry

Estimate = tuple[float | None, str]
"""A value, or None for what is about its own estimate, and its unit."""
_SAME = 1e-9
"""Relative difference up to which two covariances are one: both come from one number in JSON."""


@dataclass(frozen=True)
class Placed:
    """A pose among the unknowns.

    Attributes:
        record: its name in the calibration.
        pose: (4, 4) as it was estimated.
        inverted: whether the base in the world is its inverse.
        mount: (4, 4) its parent in the last link of the chain; None for what stands in the base.
        columns: of x y z and, of a full pose, rx ry rz.
    """

    record: str
    pose: FloatArray
    inverted: bool
    mount: FloatArray | None
    columns: tuple[int, ...]


@dataclass(frozen=True)
class Part:
    """Unknowns of one kind in a cause.

    Attributes:
        name: in words.
        category: id of its category.
        columns: its unknowns.
        estimate: unknown -> its value and unit.
    """

    name: str
    category: str
    columns: tuple[int, ...]
    estimate: Mapping[str, Estimate]


@dataclass(frozen=True)
class Calibrated:
    """What one calibration leaves uncertain of a task's frame.

    Attributes:
        entry: the record in the twin.
        names: (p,) unknowns.
        covariance: (p, p), m, rad and s.
        parts: unknowns by kind.
        placed: poses among them.
        zeros: joint of the chain -> column.
        links: deviations of links, each with its column.
        delay: column of the time offset, or None.
        left_out: what moves nothing here, and why.
    """

    entry: CalibrationEntry
    names: tuple[str, ...]
    covariance: FloatArray
    parts: tuple[Part, ...]
    placed: tuple[Placed, ...] = ()
    zeros: Mapping[int, int] = field(default_factory=dict)
    links: tuple[tuple[LinkParameter, int], ...] = ()
    delay: int | None = None
    left_out: tuple[str, ...] = ()

    def frame(self, task: Task, step: FloatArray) -> Moving:
        """The task's frame after a step of the unknowns, with derivatives at step 0.

        Displacements are what counts: the base's own pose in the world, which moves all alike, is
        left out.
        """
        chain, width = task.chain, len(self.names)
        columns = tuple(self.zeros.get(at, -1) for at in range(len(chain.joints)))
        zeros = np.array([0.0 if at < 0 else step[at] for at in columns])
        links = tuple(link for link, _ in self.links)
        at = tuple(column for _, column in self.links)
        parameters = ChainParameters(
            width, zeros, columns, links, step[list(at)] if at else None, at
        )
        readings, drift = task.readings, np.zeros((0, 0))
        if self.delay is not None:
            assert task.velocity is not None
            readings = readings + step[self.delay] * task.velocity
            drift = task.velocity * chain.signs
        moving = forward(replace(chain, end=np.eye(4)), readings, parameters)
        if self.delay is not None:
            moving = self._late(task, readings, moving, drift)
        rows = len(readings)
        for one in self.placed:
            if one.mount is not None:
                own = _moved(one, step, width, rows)
                back = _still(inverse(one.pose) @ inverse(one.mount), width, rows)
                moving = moving @ _still(one.mount, width, rows) @ own @ back
        moving = moving @ _still(chain.end, width, rows)
        for one in self.placed:
            if one.mount is None:
                own = _moved(one, step, width, rows) @ _still(inverse(one.pose), width, rows)
                moving = (own.inverse() if one.inverted else own) @ moving
        return moving

    def _late(self, task: Task, readings: FloatArray, moving: Moving, drift: FloatArray) -> Moving:
        """The derivative by the time offset: that by each joint times its velocity."""
        count = len(task.chain.joints)
        every = ChainParameters(count, np.zeros(count), tuple(range(count)))
        by_joint = forward(replace(task.chain, end=np.eye(4)), readings, every)
        turn, shift = moving.turn.copy(), moving.shift.copy()
        turn[:, :, self.delay] = np.einsum("nij,nj->ni", by_joint.turn, drift)
        shift[:, :, self.delay] = np.einsum("nij,nj->ni", by_joint.shift, drift)
        return Moving(moving.rotation, moving.position, turn, shift)


def calibrated(entry: CalibrationEntry, task: Task, twin: Path, taken: set[str]) -> Calibrated:
    """The unknowns of a calibration that move a task's frame.

    Args:
        entry: the record in the twin.
        task: with the chain to the frame.
        twin: ``twin.yaml``, for the frames that the record names.
        taken: records of this twin that a newer calibration measured; they are left out.
    """
    return _Reader(entry, task, twin, taken).read()


def claims(record: CalibrationRecord) -> set[str]:
    """What a calibration measures: ``zero of JOINT``, a deviation of a link, or a frame."""
    found = {f"zero of {joint}" for joint in record.joint_zeros} | set(record.deviations)
    return found | {f"{name} in {parent}" for name, (parent, _) in record.frames.items()}


class _Reader:
    def __init__(self, entry: CalibrationEntry, task: Task, twin: Path, taken: set[str]) -> None:
        self.entry, self.record, self.task, self.twin = entry, entry.record, task, twin
        self.taken = taken
        self.of = list(self.record.covariance_names)
        self.covariance = np.reshape(self.record.covariance, (len(self.of), len(self.of)))
        self.kept: list[int] = []
        self.parts: list[Part] = []
        self.left_out: list[str] = []

    def read(self) -> Calibrated:
        zeros = self._zeros()
        links = tuple(self._links())
        placed = tuple(self._placed())
        delay = self._delay()
        names = tuple(self.of[at] for at in self.kept)
        covariance = self.covariance[np.ix_(self.kept, self.kept)]
        return Calibrated(
            self.entry, names, covariance, tuple(self.parts), placed, zeros, links, delay,
            tuple(self.left_out),
        )  # fmt: skip

    def _keep(self, columns: Sequence[int]) -> tuple[int, ...]:
        start = len(self.kept)
        self.kept += columns
        return tuple(range(start, len(self.kept)))

    def _zeros(self) -> dict[int, int]:
        found: dict[int, int] = {}
        estimate: dict[str, Estimate] = {}
        for joint, value in self.record.joint_zeros.items():
            name = f"joint_zeros.{joint}"
            if "joint_zeros" not in self.entry.use or name not in self.of:
                self._without(f"the zero of {joint}", "joint_zeros" in self.entry.use)
            elif joint not in self.task.chain.joints:
                self.left_out.append(f"the zero of {joint}: not on the chain to the frame")
            elif not self._is_taken(f"zero of {joint}"):
                at = self.task.chain.joints.index(joint)
                (found[at],) = self._keep([self.of.index(name)])
                estimate[joint] = (value, "rad" if self.task.chain.revolute[at] else "m")
        self._part("joint zeros", "joint_zeros", tuple(found.values()), estimate)
        return found

    def _links(self) -> Iterator[tuple[LinkParameter, int]]:
        columns: list[int] = []
        estimate: dict[str, Estimate] = {}
        for label, one in self.record.deviations.items():
            name = f"geometry.{label}"
            if name not in self.of:
                self._without(label, True)
            elif one.joint not in self.task.chain.joints:
                self.left_out.append(f"{label}: not on the chain to the frame")
            elif not self._is_taken(label):
                (column,) = self._keep([self.of.index(name)])
                columns.append(column)
                unit = "rad" if one.rotation else "m"
                estimate[label] = (one.value, unit)
                at = self.task.chain.joints.index(one.joint)
                yield LinkParameter(at, one.rotation, np.array(one.direction), label), column
        self._part("link geometry", "geometry", tuple(columns), estimate)

    def _placed(self) -> Iterator[Placed]:
        for name in ("base_world", "robot_world", "fixture", "hand_eye", "tcp"):
            if name not in self.record.frames or name not in self.record.covariances:
                continue
            parent, child = self.record.frames[name]
            if name == "base_world" and name not in self.entry.use:
                self._without("the base in the world", False)
                continue
            if self._is_taken(f"{name} in {parent}"):
                continue
            standing = parent in ("base", "world", self.task.chain.base)
            mount = None
            if not standing or name == "tcp":
                mount = self._mount(name, parent)
                if mount is None:
                    continue
            raw, columns = self._columns(name)
            kept = self._keep(columns)
            xyz = self.record.transforms[name][0]
            estimate = self._estimates(name, xyz, len(kept))
            self._part(f"{child} in {parent} ({name})", name, kept, estimate)
            yield Placed(name, raw, name == "base_world", mount, kept)

    @staticmethod
    def _estimates(name: str, xyz: Sequence[float], size: int) -> dict[str, Estimate]:
        """Rotations are about what was estimated: they have a spread and no value."""
        values = [*xyz, None, None, None]
        units = ("m",) * 3 + ("rad",) * 3
        return {
            f"{name}.{label}": (values[at], units[at])
            for at, label in enumerate(POSE_LABELS[:size])
        }

    def _columns(self, name: str) -> tuple[FloatArray, list[int]]:
        """The pose as it was estimated, and its columns among all unknowns."""
        xyz, quaternion = self.record.transforms[name]
        turn = np.eye(3) if quaternion is None else rotation_of(quaternion)
        stated, own = rigid(turn, np.array(xyz)), np.array(self.record.covariances[name])
        raw = inverse(stated) if name == "base_world" else stated
        for columns in self._blocks(len(own)):
            block = self.covariance[np.ix_(columns, columns)]
            told = inverse_with_covariance(raw, block)[1] if name == "base_world" else block
            if np.allclose(told, own, rtol=_SAME, atol=_SAME * float(np.abs(own).max())):
                return raw, columns
        # A record on its own: nothing says how it varies with the others.
        if name == "base_world":
            own = inverse_with_covariance(stated, own)[1]
        columns = self._append([f"{name}.{label}" for label in POSE_LABELS[: len(own)]], own)
        return raw, columns

    def _blocks(self, size: int) -> Iterator[list[int]]:
        kind, labels = ("pose:", POSE_LABELS) if size == len(POSE_LABELS) else ("point:", "xyz")
        for at, name in enumerate(self.of[: len(self.of) - size + 1]):
            stem = name.removesuffix(f".{labels[0]}")
            wanted = [f"{stem}.{label}" for label in labels]
            if name.startswith(kind) and self.of[at : at + size] == wanted:
                yield list(range(at, at + size))

    def _append(self, names: Sequence[str], block: FloatArray) -> list[int]:
        start, size = len(self.of), len(names)
        grown = np.zeros((start + size, start + size))
        grown[:start, :start] = self.covariance
        grown[start:, start:] = block
        self.covariance = grown
        self.of += names
        return list(range(start, start + size))

    def _mount(self, name: str, parent: str) -> FloatArray | None:
        """The parent of a pose in the last link of the chain."""
        try:
            own = load_serial_chain(self.twin, parent)
        except TwinError:
            self.left_out.append(f"{name}: the model has no frame {parent!r}")
            return None
        if own.joints != self.task.chain.joints:
            self.left_out.append(
                f"{name}: {parent!r} is not fixed to the link of {self.task.frame!r}; budget: "
                "frame: with a frame of that link counts it"
            )
            return None
        return np.asarray(own.end)

    def _delay(self) -> int | None:
        if self.record.time_offset is None or "time_offset" in self.taken:
            return None
        if self.task.velocity is None:
            self.left_out.append(
                "the time offset: no speed is known; budget: recordings: with the task's motion "
                "gives it"
            )
            return None
        value, deviation = self.record.time_offset
        (column,) = self._keep(self._append(["time_offset"], np.array([[deviation**2]])))
        self._part("time offset", "time_offset", (column,), {"time offset": (value, "s")})
        return column

    def _part(
        self,
        words: str,
        record: str,
        columns: tuple[int, ...],
        estimate: Mapping[str, Estimate],
    ) -> None:
        if columns:
            self.parts.append(Part(words, category_of_record(record), columns, estimate))

    def _is_taken(self, claim: str) -> bool:
        if claim in self.taken:
            self.left_out.append(f"{claim}: a newer calibration measured it")
        return claim in self.taken

    def _without(self, what: str, used: bool) -> None:
        why = "its covariance is not in the record" if used else "twin.yaml does not use it"
        self.left_out.append(f"{what}: {why}")


def _moved(one: Placed, step: FloatArray, width: int, rows: int) -> Moving:
    """A pose after a step: ``t + d``, ``R exp(r)``, with derivatives."""
    own = step[list(one.columns)]
    shift, turn = np.zeros((3, width)), np.zeros((3, width))
    shift[:, list(one.columns[:3])] = np.eye(3)
    rotation = one.pose[:3, :3]
    if len(own) > 3:
        turn[:, list(one.columns[3:])] = rotation @ left_jacobian(own[3:])
        rotation = rotation @ Rotation.from_rotvec(own[3:]).as_matrix()
    return Moving(
        np.tile(rotation, (rows, 1, 1)),
        np.tile(one.pose[:3, 3] + own[:3], (rows, 1)),
        np.tile(turn, (rows, 1, 1)),
        np.tile(shift, (rows, 1, 1)),
    )


def _still(pose: FloatArray, width: int, rows: int) -> Moving:
    """A pose that no unknown moves."""
    nothing = np.zeros((rows, 3, width))
    return Moving(
        np.tile(pose[:3, :3], (rows, 1, 1)), np.tile(pose[:3, 3], (rows, 1)), nothing, nothing
    )
