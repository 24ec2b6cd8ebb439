"""Forward kinematics of named frames at poses, compared with the record and Pinocchio."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import known_name, tolerance
from pytest_twin.checks.poses import (
    POSES_SCHEMA,
    REFERENCE,
    joints_above,
    keyframe_parts,
    recorded_poses,
    resolve_poses,
)
from pytest_twin.checks.schemas import array, table, text
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.metrics.pose import (
    orientation_error,
    pose_vector,
    position_error,
    rotation_of,
)
from pytest_twin.twin import Simulator

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_MANY_SITES = 12
"""Number of sites on moving bodies above which a first spec omits them."""
_NOWHERE = [float("nan")] * 7
"""Pose of a frame that the record lacks."""


class ForwardKinematics(Check):
    """Pose of named frames (bodies or sites) in the world.

    ``values``: ``poses`` (drawn poses) and ``frames``: pose -> frame -> position in m and
    quaternion (w, x, y, z).
    """

    kind: ClassVar[str] = "fk"
    simulators: ClassVar[tuple[Simulator, ...]] = ("mujoco", "newton")
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "pin")
    tolerances: ClassVar[Mapping[str, str]] = {"position": "m", "orientation": "rad"}
    required_tolerances: ClassVar[frozenset[str]] = frozenset({"position", "orientation"})
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "frames": array(
                    text(minLength=1),
                    "Bodies or sites whose pose in the world is compared.",
                    minItems=1,
                    uniqueItems=True,
                )
            },
            required=["frames"],
        ),
        "stimulus": table({"poses": POSES_SCHEMA}, required=["poses"]),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return kinematics of the chains to the frames, their couplings, and named keyframes."""
        return structure.chain(golden.target["frames"]) | keyframe_parts(golden, structure)

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute the frames at every pose with the realization's simulator and Pinocchio."""
        from pytest_twin.realization import simulate

        structure = realization.structure
        frames = [
            known_name(golden, f"target.frames.{i}", name, structure.frame_body, "frame")
            for i, name in enumerate(golden.target["frames"])
        ]
        moved = joints_above(structure, [structure.frame_body[frame] for frame in frames])
        poses = resolve_poses(golden, realization, moved=moved)
        forward = simulate.forward_kinematics(realization)
        found: dict[str, dict[str, list[float]]] = {}
        reference: dict[str, dict[str, list[float]]] = {}
        for number, pose in enumerate(poses):
            found[pose.name] = {
                frame: pose_vector(place).tolist()
                for frame, place in forward(pose.qpos, frames).items()
            }
            reference[pose.name] = {
                frame: pose_vector(realization.reference.frame_pose(pose.joints, frame)).tolist()
                for frame in frames
            }
            progress((number + 1) / len(poses))
        return Observation(
            {"poses": recorded_poses(poses), "frames": found}, reference={"frames": reference}
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare position and orientation of each frame at its worst pose with each source."""
        found = observation.values["frames"]
        sources = [("pinocchio", observation.reference["frames"])]
        if golden.expected is not None:
            sources.insert(0, ("golden", golden.expected.get("frames", {})))
        measures = []
        for frame in golden.target["frames"]:
            for against, expected in sources:
                errors = {
                    pose: _errors(at[frame], expected.get(pose, {}).get(frame, _NOWHERE))
                    for pose, at in found.items()
                }
                for index, name in enumerate(("position", "orientation")):
                    pose = max(errors, key=lambda key: _worst_first(errors[key][index]))
                    error = errors[pose][index]
                    bound = tolerance(golden, name, "every fk golden bounds it")
                    measures.append(
                        Measure.of_error(name, f"{frame} at {pose}", error, bound, against)
                    )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose the ends of all chains at reference, keyframes and twenty random poses."""
        frames = end_frames(realization)
        if not frames:
            raise NothingToProposeError("no joint moves a frame that has a name")
        model = realization.model
        keyframes = [name for i in range(model.nkey) if (name := model.key(i).name)]
        return [
            {
                "name": "frames",
                "title": "Poses of the ends of all kinematic chains",
                "target": {"frames": frames},
                "stimulus": {"poses": [REFERENCE, *keyframes, {"seed": 1, "count": 20}]},
                "tolerance": {"position": "1 um", "orientation": "1e-6 rad"},
            }
        ]


def end_frames(realization: Realization) -> list[str]:
    """Return frames at chain ends: moving leaf bodies, sites on moving bodies, the twin's TCP.

    Sites are omitted if there are many, as with tendon routes or tactile cells.
    """
    structure = realization.structure
    jointed = set(structure.joint_body.values())
    moving = {b for b in structure.body_parent if jointed.intersection(structure.ancestors(b))}
    frames = moving - set(structure.body_parent.values())
    sites = {site for site in realization.names("site") if structure.frame_body[site] in moving}
    if len(sites) <= _MANY_SITES:
        frames |= sites
    twin = realization.twin
    if twin is not None and twin.tcp is not None:
        frames.add(twin.tcp)
    return sorted(frames.intersection((*realization.names("body"), *realization.names("site"))))


def _errors(found: list[float], expected: list[float]) -> tuple[float, float]:
    """Return distance [m] and angle [rad] of two poses (position, quaternion); NaN if one is."""
    if not np.isfinite([*found, *expected]).all() or len(found) != len(expected):
        return float("nan"), float("nan")
    return (
        position_error(found[:3], expected[:3]),
        orientation_error(rotation_of(found[3:]), rotation_of(expected[3:])),
    )


def _worst_first(error: float) -> float:
    return float("inf") if np.isnan(error) else error
