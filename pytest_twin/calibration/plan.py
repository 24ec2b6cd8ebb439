"""Read calibration plans: what to estimate, from which observations, with which accuracy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import PathError, SpecError
from pytest_twin.formats import yaml
from pytest_twin.formats.paths import Roots
from pytest_twin.formats.schema import load_schema, validate
from pytest_twin.metrics.pose import rigid, rotation_of

Mount = Literal["hand", "world"]

GEOMETRY_TRANSLATION_M = 0.002
"""Prior standard deviation of a link's offset, the manufacturing tolerance of a 1 m arm."""

GEOMETRY_ROTATION_RAD = 0.01
"""Prior standard deviation of an axis direction, 1 mm over a bearing seat of 0.1 m."""

TARGET_TOLERANCE = 0.002
"""Prior standard deviation of a target's size, relative to the stated one. A page that an
office printer prints at full size is 0.1 to 0.5 % too small or too large."""

QUATERNION_TOLERANCE = 0.02
"""Largest deviation of a quaternion's length from 1. With four decimals it stays below 1e-3."""


@dataclass(frozen=True, slots=True)
class HoldOut:
    """Selection of held-out observations.

    Attributes:
        fraction: fraction of the observations, drawn with ``seed``; ignored if ``ids`` are given.
        seed: seed of the random draw.
        ids: ids of the held-out observations, or None.
    """

    fraction: float = 0.25
    seed: int = 0
    ids: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class Accept:
    """Largest accepted held-out RMS errors; None accepts any error.

    Attributes:
        translation: position error, m.
        rotation: angle error, rad.
        reprojection: reprojection error, px.
    """

    translation: float | None = None
    rotation: float | None = None
    reprojection: float | None = None


@dataclass(frozen=True, slots=True)
class Priors:
    """Prior standard deviations about the nominal design.

    Attributes:
        geometry_translation: of each link's offset, m.
        geometry_rotation: of each axis direction, rad.
        joint_zeros: of each joint zero, rad or m; None without prior.
    """

    geometry_translation: float = GEOMETRY_TRANSLATION_M
    geometry_rotation: float = GEOMETRY_ROTATION_RAD
    joint_zeros: float | None = None


@dataclass(frozen=True)
class Plan:
    """Content of a ``calibration.yaml``.

    Attributes:
        robot: URDF, MJCF or ``twin.yaml``; None if flange poses are given.
        flange: the robot's frame that carries camera, target, markers or tool.
        streams: ``hand`` and ``camera`` -> file of poses, each on its own clock.
        estimate: names of the estimated quantities.
        mount: ``hand`` for a camera on the flange, ``world`` for a fixed camera.
        camera, target: fields of the plan, unchanged.
        points: marker -> (3,) known position in the tool's frame, m.
        given: name of a record -> (4, 4) known transform, m.
        priors: standard deviations about the nominal design.
        hold_out: selection of held-out observations.
        accept: largest accepted held-out errors.
        references: pose -> joint -> its position at a hard stop or an index mark, rad or m.
        topics, frames: for recordings: measured quantity -> topic, or frame in ``/tf``.
        lines: dotted field -> 1-based line number.
        roots: folders whose files the plan may name; its own folder by default.
    """

    id: str
    path: Path
    robot: Path | None
    flange: str
    observations: tuple[Path, ...]
    streams: Mapping[str, Path]
    estimate: tuple[str, ...]
    mount: Mount
    camera: Mapping[str, Any]
    target: Mapping[str, Any]
    points: Mapping[str, FloatArray]
    given: Mapping[str, FloatArray]
    priors: Priors
    hold_out: HoldOut
    accept: Accept
    references: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    topics: Mapping[str, str] = field(default_factory=dict)
    frames: Mapping[str, str] = field(default_factory=dict)
    lines: Mapping[str, int] = field(default_factory=dict, repr=False)
    roots: Roots | None = None

    @property
    def has_free_scale(self) -> bool:
        """Whether the scale of the camera's positions is unknown and estimated."""
        return self.camera.get("scale") == "estimate"

    @property
    def target_tolerance(self) -> float:
        """Prior standard deviation of the target's size, relative to the stated one."""
        return float(self.target.get("tolerance", TARGET_TOLERANCE))

    def error(self, where: str, problem: str, **details: Any) -> SpecError:
        """Return an error for a dotted field of the plan, with its line number."""
        inner = where
        while inner and inner not in self.lines:
            inner = inner.rpartition(".")[0]
        return SpecError(
            problem, path=self.path, line=self.lines.get(inner), where=where, **details
        )


def _roots(listed: Sequence[str], path: Path, lines: Mapping[str, int]) -> Iterator[Path]:
    """Folders outside the plan's from which it allows to read."""
    for at, reference in enumerate(listed):
        where = f"roots.{at}"
        folder = path.parent / reference
        if not folder.is_dir():
            raise PathError(
                "no such folder", path=path, line=lines.get(where), where=where, value=reference,
                expected="a folder",
            )  # fmt: skip
        yield folder


def load_plan(path: Path) -> Plan:
    """Read and check a ``calibration.yaml``.

    Raises:
        FormatError: the file is no strict YAML or exceeds the limits on its size.
        SpecError: a field is unknown, missing or invalid.
        PathError: a file is missing, a link, or outside the plan's folder.
    """
    path = path.parent.resolve() / path.name
    document = yaml.load(path)
    validate(document, load_schema("calibration.schema.json"), path)
    data: Mapping[str, Any] = document.data
    own = Roots(path.parent)
    roots = Roots(own.base, tuple(_roots(data.get("roots", ()), path, document.lines)))

    def file(reference: str, where: str, *, folder: bool = False) -> Path:
        line = document.lines.get(where)
        return roots.resolve(reference, at=path, line=line, where=where, folder=folder)

    def observed(reference: str, where: str) -> Path:
        return file(reference, where, folder=(path.parent / reference).is_dir())

    listed = data.get("observations", ())
    observations: tuple[Path, ...]
    if isinstance(listed, str):
        observations = (observed(listed, "observations"),)
    else:
        observations = tuple(observed(one, f"observations.{i}") for i, one in enumerate(listed))
    hold_out = data.get("hold_out", {})
    priors = data.get("priors", {})
    geometry = priors.get("geometry", {})
    target = data.get("target", {})
    plan = Plan(
        id=data["calibration"],
        path=path,
        robot=file(data["robot"], "robot") if "robot" in data else None,
        flange=data.get("flange", "flange"),
        observations=observations,
        streams={
            name: file(one, f"streams.{name}") for name, one in data.get("streams", {}).items()
        },
        estimate=tuple(data["estimate"]),
        mount=data.get("camera", {}).get("mount", "hand"),
        camera=data.get("camera", {}),
        target=target,
        points={name: np.array(xyz, dtype=float) for name, xyz in target.get("points", {}).items()},
        given={},
        priors=Priors(
            float(geometry.get("translation", GEOMETRY_TRANSLATION_M)),
            float(geometry.get("rotation", GEOMETRY_ROTATION_RAD)),
            priors.get("joint_zeros"),
        ),
        hold_out=HoldOut(
            float(hold_out.get("fraction", HoldOut().fraction)),
            int(hold_out.get("seed", 0)),
            tuple(str(one) for one in hold_out["ids"]) if "ids" in hold_out else None,
        ),
        accept=Accept(**data.get("accept", {})),
        references=data.get("references", {}),
        topics=data.get("recordings", {}).get("topics", {}),
        frames=data.get("recordings", {}).get("frames", {}),
        lines=document.lines,
        roots=roots,
    )
    if not plan.observations and not plan.streams:
        raise plan.error("", "no observations", expected="observations: observations.csv")
    if plan.robot is not None and "flange" not in data:
        raise plan.error(
            "robot",
            "no flange is named",
            expected="flange: the robot's frame that carries camera, target, markers or tool",
        )
    object.__setattr__(plan, "given", _read_given_poses(plan, data.get("given", {})))
    return plan


def _read_given_poses(plan: Plan, data: Mapping[str, Any]) -> dict[str, FloatArray]:
    found = {}
    for name, pose in data.items():
        where = f"given.{name}"
        if name in plan.estimate:
            raise plan.error(
                where,
                "given and to be estimated",
                value=name,
                expected="either under given: or in estimate:",
            )
        quaternion = np.array(pose["quaternion_wxyz"], dtype=float)
        length = float(np.linalg.norm(quaternion))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            raise plan.error(
                f"{where}.quaternion_wxyz",
                "a quaternion that is not of unit length",
                value=f"length {length:.4g}",
                expected="w x y z, of length 1",
            )
        transform = rigid(rotation_of(quaternion), pose["xyz"])
        found[name] = transform
    return found
