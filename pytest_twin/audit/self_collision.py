"""Distances of collision shapes to each other at declared poses, by two engines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from pytest_twin.audit.asset import Asset
from pytest_twin.audit.finding import Finding
from pytest_twin.errors import ModelError, TwinError
from pytest_twin.realization import load
from pytest_twin.realization.collision import Shapes
from pytest_twin.realization.model import Realization

BASE_POSE = "zeros, within the ranges"
_NEAR = 0.05
"""m: pairs farther apart than this are not listed."""
_MOST_PAIRS = 400
"""Pairs of one pose whose distance is computed, the nearest by their bounding spheres."""
_MOST_POSES = 20
_TOUCH = 1e-3
"""m: overlap that rounded origins and the hulls of meshes do not explain."""
_AGREE = 1e-4
"""m: how far two engines may differ."""


@dataclass(frozen=True, slots=True)
class Near:
    """Two bodies near each other.

    Attributes:
        distance: m, negative where they overlap, by MuJoCo; by_coal: the same, None where coal
            finds none.
    """

    first: str
    second: str
    distance: float
    by_coal: float | None


@dataclass(frozen=True, slots=True)
class PoseResult:
    """One pose: values of joints in rad or m, and what is near what, the nearest first."""

    name: str
    values: Mapping[str, float]
    near: tuple[Near, ...]
    looked_at: int
    pairs: int

    @property
    def overlapping(self) -> frozenset[str]:
        """Bodies that overlap with another."""
        return frozenset(
            name for n in self.near if n.distance < -_TOUCH for name in (n.first, n.second)
        )


def poses(asset: Asset, declared: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Name -> joint -> rad or m: zeros moved into the ranges, keyframes, and what is declared."""
    base = {}
    for joint in asset.joints:
        if joint.scalar:
            value = joint.reference
            if joint.limited and joint.lower is not None and joint.upper is not None:
                value = min(max(value, joint.lower), joint.upper)
            base[joint.name] = value
    for mimic in asset.mimics:
        if mimic.follower in base and mimic.leader in base:
            base[mimic.follower] = mimic.multiplier * base[mimic.leader] + mimic.offset
    found = {BASE_POSE: base}
    for source in (asset.poses, declared):
        for name, values in source.items():
            if len(found) <= _MOST_POSES:
                known = {joint: v for joint, v in values.items() if joint in base}
                found[name] = base | known
    return found


def measure(
    asset: Asset, declared: Mapping[str, Mapping[str, float]]
) -> tuple[list[PoseResult], list[Finding]]:
    """Distances at every pose, and what they say; unknown where no simulator takes the model."""
    if not any(shape.role == "collision" for shape in asset.shapes):
        return [], [_unknown(asset, "it has no collision shape", "collision shapes, from CAD")]
    try:
        realization = load(asset.path, accept_invalid_inertia=True)
    except TwinError as error:
        return [], [
            _unknown(asset, f"the model does not load: {error.problem}", "a model that loads")
        ]
    shapes = Shapes(realization)
    results = [
        _at(realization, shapes, name, values) for name, values in poses(asset, declared).items()
    ]
    return results, [finding for result in results for finding in _findings(asset, result)]


def _unknown(asset: Asset, why: str, settle: str) -> Finding:
    return Finding(
        "meshes.distances_unknown",
        "unknown",
        asset.place,
        f"robot '{asset.name}'",
        f"distances of its bodies to each other are unknown: {why}",
        why="a self-collision that is not seen here is found by the robot",
        settle=settle,
    )


def _at(
    realization: Realization, shapes: Shapes, name: str, values: Mapping[str, float]
) -> PoseResult:
    model = realization.model
    data = mujoco.MjData(model)
    known = {joint: value for joint, value in values.items() if joint in realization.joints}
    data.qpos[:] = realization.qpos(known)
    mujoco.mj_kinematics(model, data)
    pairs = _pairs(model)
    gaps = []
    for first, second in pairs:
        gap = float(np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second]))
        gaps.append(gap - float(model.geom_rbound[first] + model.geom_rbound[second]))
    order = [i for i in np.argsort(gaps) if gaps[i] < _NEAR][:_MOST_PAIRS]
    found: dict[tuple[str, str], Near] = {}
    for index in order:
        first, second = pairs[index]
        near = _near(realization, shapes, data, first, second)
        if near is None:
            continue
        key = (near.first, near.second)
        if near.distance < _NEAR and (key not in found or near.distance < found[key].distance):
            found[key] = near
    return PoseResult(
        name,
        dict(known),
        tuple(sorted(found.values(), key=lambda n: n.distance)),
        len(order),
        sum(gap < _NEAR for gap in gaps),
    )


def _near(
    realization: Realization, shapes: Shapes, data: mujoco.MjData, first: int, second: int
) -> Near | None:
    model = realization.model
    sides = frozenset({first}), frozenset({second})
    names = [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[geom]))
        or f"body {int(model.geom_bodyid[geom])}"
        for geom in (first, second)
    ]
    try:
        distance = shapes.distance(data, *sides)
        by_coal = shapes.distance_by_coal(data, *sides) if distance < _NEAR else float("nan")
    except ModelError:
        return None
    low, high = sorted(names)
    return Near(low, high, distance, by_coal if np.isfinite(by_coal) else None)


def _pairs(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Pairs of geoms of the robot that MuJoCo would let collide."""
    geoms = [
        g
        for g in range(model.ngeom)
        if (model.geom_contype[g] or model.geom_conaffinity[g])
        and int(model.geom_type[g]) != int(mujoco.mjtGeom.mjGEOM_PLANE)
    ]
    excluded = {int(signature) for signature in model.exclude_signature}
    weld, parent = model.body_weldid, model.body_parentid
    found = []
    for at, first in enumerate(geoms):
        a = int(model.geom_bodyid[first])
        for second in geoms[at + 1 :]:
            b = int(model.geom_bodyid[second])
            wa, wb = int(weld[a]), int(weld[b])
            family = wa == wb or wa == weld[parent[wb]] or wb == weld[parent[wa]]
            low, high = min(a, b), max(a, b)
            if family or (low << 16) + high in excluded:
                continue
            contype, conaffinity = model.geom_contype, model.geom_conaffinity
            if contype[first] & conaffinity[second] or contype[second] & conaffinity[first]:
                found.append((first, second))
    return found


def _findings(asset: Asset, result: PoseResult) -> Iterator[Finding]:
    for near in result.near:
        if near.distance >= -_TOUCH:
            continue
        body = asset.body.get(near.second)
        shapes = asset.shapes_of(near.second)
        place = shapes[0].place if shapes else (body.place if body else asset.place)
        agreed = near.by_coal is not None and abs(near.by_coal - near.distance) < max(
            _AGREE, 0.05 * abs(near.distance)
        )
        yield Finding(
            "meshes.self_collision",
            "warning",
            place,
            f"links '{near.first}' and '{near.second}'",
            f"their collision shapes overlap at the pose '{result.name}'"
            + ("" if agreed else ", by how much MuJoCo and coal do not agree"),
            near.distance,
            "m",
            "no overlap at a pose that the robot can stand in"
            + (f"; coal finds {near.by_coal:.4g} m" if near.by_coal is not None else ""),
            "a simulator pushes them apart from the first step on, or the pair has to be disabled",
            "a photograph of the robot at this pose; smaller collision shapes, or the pair "
            "declared as never colliding",
        )
    if result.pairs > result.looked_at:
        yield Finding(
            "meshes.distances_unknown",
            "unknown",
            asset.place,
            f"robot '{asset.name}'",
            f"at the pose '{result.name}' only the {result.looked_at} pairs of shapes nearest by "
            f"their bounding spheres were looked at, of {result.pairs} that may be near",
            why="a self-collision that is not seen here is found by the robot",
            settle="a golden of kind collision_distance for the pairs that matter",
        )


def to_json(results: Sequence[PoseResult]) -> list[dict[str, object]]:
    """Plain data."""
    return [
        {
            "pose": result.name,
            "values": dict(result.values),
            "near": [
                {
                    "bodies": [near.first, near.second],
                    "distance": {"value": near.distance, "unit": "m", "by": "MuJoCo"},
                    "check": {"value": near.by_coal, "unit": "m", "by": "coal"},
                }
                for near in result.near[:100]
            ],
        }
        for result in results
    ]
