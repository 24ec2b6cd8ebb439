"""Read the unknowns of a calibration record that move a task's frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.budget.calibration import (
    CalibrationUnknowns,
    Estimate,
    Part,
    UncertainPose,
)
from pytest_twin.budget.categories import category_of_record
from pytest_twin.budget.task import Task
from pytest_twin.calibration.chain import LinkParameter
from pytest_twin.calibration.parameters import POSE_LABELS
from pytest_twin.calibration.records import inverse_with_covariance
from pytest_twin.errors import TwinError
from pytest_twin.formats.calibration_record import CalibrationRecord
from pytest_twin.metrics.pose import inverse, rigid, rotation_of
from pytest_twin.realization.serial_chain import load_serial_chain
from pytest_twin.twin import CalibrationEntry

_SAME = 1e-9
"""Relative difference below which two covariances are equal. Both come from the same number in
JSON."""


def read_calibration_unknowns(
    entry: CalibrationEntry, task: Task, twin: Path, taken: set[str]
) -> CalibrationUnknowns:
    """Return the unknowns of a calibration that move a task's frame.

    Args:
        entry: the record in the twin.
        task: task with the kinematic chain to the frame.
        twin: path of ``twin.yaml``, for the frames that the record names.
        taken: quantities that a newer calibration of the twin measured; they are left out.
    """
    return _Reader(entry, task, twin, taken).read()


def claims(record: CalibrationRecord) -> set[str]:
    """Return what a calibration measures: ``zero of JOINT``, link deviations and frames."""
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

    def read(self) -> CalibrationUnknowns:
        zeros = self._zeros()
        links = tuple(self._links())
        placed = tuple(self._placed())
        delay = self._delay()
        names = tuple(self.of[at] for at in self.kept)
        covariance = self.covariance[np.ix_(self.kept, self.kept)]
        return CalibrationUnknowns(
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
                unit = "rad" if one.is_rotation else "m"
                estimate[label] = (one.value, unit)
                at = self.task.chain.joints.index(one.joint)
                yield LinkParameter(at, one.is_rotation, np.array(one.direction), label), column
        self._part("link geometry", "geometry", tuple(columns), estimate)

    def _placed(self) -> Iterator[UncertainPose]:
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
            yield UncertainPose(name, raw, mount, kept)

    @staticmethod
    def _estimates(name: str, xyz: Sequence[float], size: int) -> dict[str, Estimate]:
        """Return value and unit of each unknown; rotations are deviations and have no value."""
        values = [*xyz, None, None, None]
        units = ("m",) * 3 + ("rad",) * 3
        return {
            f"{name}.{label}": (values[at], units[at])
            for at, label in enumerate(POSE_LABELS[:size])
        }

    def _columns(self, name: str) -> tuple[FloatArray, list[int]]:
        """Return the estimated pose, and its columns among all unknowns."""
        xyz, quaternion = self.record.transforms[name]
        turn = np.eye(3) if quaternion is None else rotation_of(quaternion)
        stated, own = rigid(turn, np.array(xyz)), np.array(self.record.covariances[name])
        raw = inverse(stated) if name == "base_world" else stated
        for columns in self._blocks(len(own)):
            block = self.covariance[np.ix_(columns, columns)]
            told = inverse_with_covariance(raw, block)[1] if name == "base_world" else block
            if np.allclose(told, own, rtol=_SAME, atol=_SAME * float(np.abs(own).max())):
                return raw, columns
        self.left_out.append(
            f"the covariance of {name} with the rest: it is not in the record, and counts as 0"
        )
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
        """Return the pose of a parent frame in the last link of the chain."""
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
                "the time offset: no speed is known; budget: recordings: with the task's motion, "
                "without poses:, gives it"
            )
            return None
        value, deviation = self.record.time_offset
        columns = (
            [self.of.index("time_offset")]
            if "time_offset" in self.of
            else self._append(["time_offset"], np.array([[deviation**2]]))
        )
        (column,) = self._keep(columns)
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
