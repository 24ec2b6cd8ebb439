"""What a calibration estimates, from which observations, and what it must reach."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.errors import SpecError
from pytest_twin.formats import yaml
from pytest_twin.formats.paths import Roots
from pytest_twin.formats.schema import load_schema, validate
from pytest_twin.metrics.pose import rotation_of

Mount = Literal["hand", "world"]

GEOMETRY_TRANSLATION_M = 0.002
"""Prior standard deviation of a link's offset: what castings of a 1 m arm are machined to."""

GEOMETRY_ROTATION_RAD = 0.01
"""Prior standard deviation of an axis' direction: 1 mm over a bearing seat of 0.1 m."""

QUATERNION_TOLERANCE = 0.02
"""A quaternion whose length is further from 1 is refused: four decimals keep it within 1e-3."""


@dataclass(frozen=True, slots=True)
class HoldOut:
    """Which observations nothing is fitted on.

    Attributes:
        fraction: part of the observations, drawn with ``seed``; not used where there are ``ids``.
        ids: the observations themselves, or None.
    """

    fraction: float = 0.25
    seed: int = 0
    ids: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True)
class Accept:
    """What the held-out root mean squares must stay below; None where nothing is asked.

    Attributes:
        translation: m.
        rotation: rad.
        reprojection: px.
    """

    translation: float | None = None
    rotation: float | None = None
    reprojection: float | None = None


@dataclass(frozen=True, slots=True)
class Priors:
    """Standard deviations of the design about its nominal values.

    Attributes:
        geometry_translation: m, of each link's offset.
        geometry_rotation: rad, of each axis' direction.
        joint_zeros: rad or m, None for a free zero.
    """

    geometry_translation: float = GEOMETRY_TRANSLATION_M
    geometry_rotation: float = GEOMETRY_ROTATION_RAD
    joint_zeros: float | None = None


@dataclass(frozen=True)
class Plan:
    """One calibration, as ``calibration.yaml`` states it.

    Attributes:
        id: of the record.
        path: the file.
        robot: URDF, MJCF or ``twin.yaml``, None where flange poses are given.
        flange: the robot's frame that carries camera, target, markers or tool.
        observations: files of observations.
        streams: ``hand`` and ``camera`` -> file of poses, each on its own clock.
        estimate: what is free.
        mount: ``hand`` where the camera moves with the flange, ``world`` where it stands still.
        camera, target: as written.
        points: marker -> (3,) place in the tool's frame, m, where that is known.
        given: name of a record -> (4, 4) transform that is held.
        references: pose -> joint -> its position at a hard stop or an index mark, rad or m.
        topics, frames: of recordings: what is observed -> topic, or frame in ``/tf``.
        lines: dotted field -> 1-based line.
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

    @property
    def has_free_scale(self) -> bool:
        """Whether positions of the target are in a unit that the camera does not know."""
        return self.camera.get("scale") == "estimate"

    def error(self, where: str, problem: str, **details: Any) -> SpecError:
        """An error at a dotted field of the plan, with its line, to be raised."""
        inner = where
        while inner and inner not in self.lines:
            inner = inner.rpartition(".")[0]
        return SpecError(
            problem, path=self.path, line=self.lines.get(inner), where=where, **details
        )


def load_plan(path: Path) -> Plan:
    """Read and check a ``calibration.yaml``.

    Raises:
        FormatError: not strict YAML, or beyond its bounds.
        SpecError: a field that is unknown, missing, or means nothing.
        PathError: a file that is missing, a link, or outside the plan's folder.
    """
    path = path.parent.resolve() / path.name
    document = yaml.load(path)
    validate(document, load_schema("calibration.schema.json"), path)
    data: Mapping[str, Any] = document.data
    roots = Roots(path.parent)

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
    )
    if not plan.observations and not plan.streams:
        raise plan.error("", "no observations", expected="observations: observations.csv")
    if plan.robot is not None and "flange" not in data:
        raise plan.error(
            "robot",
            "no flange is named",
            expected="flange: the robot's frame that carries camera, target, markers or tool",
        )
    object.__setattr__(plan, "given", _given(plan, data.get("given", {})))
    return plan


def _given(plan: Plan, data: Mapping[str, Any]) -> dict[str, FloatArray]:
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
        transform = np.eye(4)
        transform[:3, :3] = rotation_of(quaternion)
        transform[:3, 3] = pose["xyz"]
        found[name] = transform
    return found
