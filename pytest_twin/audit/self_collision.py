"""Distances between collision shapes at declared poses, by two engines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import coal
import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.audit.asset import Asset, Vector
from pytest_twin.audit.broad_phase import MOST_CANDIDATES, near_pairs
from pytest_twin.audit.finding import Finding
from pytest_twin.audit.geometry import Faces, Geometry
from pytest_twin.errors import ModelError, TwinError
from pytest_twin.realization import load
from pytest_twin.realization.collision import Shapes
from pytest_twin.realization.model import Realization

BASE_POSE = "zeros, within the ranges"
_NEAR = 0.05
"""m: pairs farther apart than this are not listed."""
_MOST_PAIRS = 1000
"""Pairs of one pose whose distance is computed, the nearest by their bounding spheres."""
_MOST_POSES = 20
_MOST_SHAPES = 20_000
"""Collision shapes of one model; the broad phase of so many takes some seconds."""
_TOUCH = 1e-3
"""m: overlap that rounded origins and the hulls of meshes do not explain."""
_AGREE = 1e-4
"""m: how far two engines may differ."""
_GOLDEN = "add a golden of kind collision_distance for the pairs of bodies that can meet"


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
    """One pose: values of joints in rad or m, and what is near what, the nearest first.

    Attributes:
        looked_at: pairs of shapes whose distance was computed.
        pairs: pairs of shapes that may be near by their bounding spheres; None where they are
            more than the broad phase lists, and no distance was computed.
        engine: that computed the distances of ``near``.
    """

    name: str
    values: Mapping[str, float]
    near: tuple[Near, ...]
    looked_at: int
    pairs: int | None
    engine: str = "MuJoCo"

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
    asset: Asset, geometry: Geometry, declared: Mapping[str, Mapping[str, float]]
) -> tuple[list[PoseResult], list[Finding]]:
    """Distances at every pose, and their findings.

    URDF and MJCF are compiled and measured by MuJoCo, and pairs that are near by coal too. A USD
    stage, and a model that does not compile, are measured by coal alone, between the convex hulls
    of the shapes that could be read.
    """
    if not any(shape.role == "collision" for shape in asset.shapes):
        return [], [_unknown(asset, "it has no collision shape", "add collision shapes from CAD")]
    realization = None
    if asset.kind != "usd":
        # A model that no simulator takes is still measured, between hulls.
        with contextlib.suppress(TwinError):
            realization = load(asset.path, located=asset.located, accept_invalid_inertia=True)
    count = len(asset.shapes) if realization is None else realization.model.ngeom
    if count > _MOST_SHAPES:
        return [], [
            _unknown(
                asset,
                f"it has {count} shapes, and distances are computed for at most {_MOST_SHAPES}",
                _GOLDEN,
            )
        ]
    shapes = None if realization is None else Shapes(realization)
    results = []
    for name, values in poses(asset, declared).items():
        if realization is None or shapes is None:
            results.append(by_hulls(asset, geometry, name, values))
        else:
            results.append(_at(realization, shapes, name, values))
    return results, [finding for result in results for finding in _findings(asset, result)]


def _unknown(asset: Asset, why: str, settle: str) -> Finding:
    return Finding(
        "meshes.distances_unknown",
        "unknown",
        asset.place,
        f"robot '{asset.name}'",
        f"distances between collision shapes were not computed: {why}",
        why="a self-collision that is not found here is found by the robot",
        settle=settle,
    )


def _at(
    realization: Realization, shapes: Shapes, name: str, values: Mapping[str, float]
) -> PoseResult:
    model = realization.model
    data = mujoco.MjData(model)
    names = set(realization.joints)
    known = {joint: value for joint, value in values.items() if joint in names}
    data.qpos[:] = realization.qpos(known)
    mujoco.mj_kinematics(model, data)
    pairs = _near_geoms(model, data)
    if pairs is None:
        return PoseResult(name, dict(known), (), 0, None)
    apart = np.linalg.norm(data.geom_xpos[pairs[:, 0]] - data.geom_xpos[pairs[:, 1]], axis=1)
    gaps = apart - model.geom_rbound[pairs].sum(axis=1)
    order = np.argsort(gaps, kind="stable")[:_MOST_PAIRS]
    found: dict[tuple[str, str], Near] = {}
    for index in order:
        first, second = (int(geom) for geom in pairs[index])
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
        len(pairs),
    )


def by_hulls(
    asset: Asset, geometry: Geometry, name: str, values: Mapping[str, float]
) -> PoseResult:
    """Distances between convex hulls by coal."""
    places = asset.at(values)
    solids = []
    for shape in asset.shapes:
        hull = geometry.hull(shape) if shape.role == "collision" else None
        if hull is None or shape.body not in places:
            continue
        position, rotation = places[shape.body]
        corners = (hull[0] @ shape.rotation.T + shape.position) @ rotation.T + position
        solids.append((shape.body, corners.min(axis=0), corners.max(axis=0), corners, hull[1]))
    low = np.array([solid[1] for solid in solids]).reshape(-1, 3)
    high = np.array([solid[2] for solid in solids]).reshape(-1, 3)
    pairs = near_pairs((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2, _NEAR)
    if pairs is None:
        return PoseResult(name, dict(values), (), 0, None, "coal")
    at, other = pairs.T
    gaps = np.maximum(low[at] - high[other], low[other] - high[at]).max(axis=1, initial=-np.inf)
    adjacent = _adjacent(asset)
    near = [
        int(i)
        for i in np.argsort(gaps, kind="stable")
        if gaps[i] < _NEAR
        and frozenset((asset.group[solids[at[i]][0]], asset.group[solids[other[i]][0]]))
        not in adjacent
    ]
    made: dict[int, coal.Convex] = {}
    found: dict[tuple[str, str], Near] = {}
    still, request = coal.Transform3s(), coal.DistanceRequest()
    request.enable_signed_distance = True
    for index in near[:_MOST_PAIRS]:
        pair = int(at[index]), int(other[index])
        for one in pair:
            if one not in made:
                made[one] = _convex(solids[one][3], solids[one][4])
        distance = coal.distance(
            made[pair[0]], still, made[pair[1]], still, request, coal.DistanceResult()
        )
        first, second = sorted((solids[pair[0]][0], solids[pair[1]][0]))
        known = found.get((first, second))
        if distance < _NEAR and (known is None or distance < known.distance):
            found[first, second] = Near(first, second, float(distance), None)
    return PoseResult(
        name,
        dict(values),
        tuple(sorted(found.values(), key=lambda n: n.distance)),
        min(len(near), _MOST_PAIRS),
        len(near),
        "coal",
    )


def _adjacent(asset: Asset) -> set[frozenset[str]]:
    """Pairs of groups of fixed bodies that are one, or meet at a joint."""
    found = {frozenset((top,)) for top in asset.group.values()}
    for edge in asset.in_order():
        found.add(frozenset((asset.group[edge.parent], asset.group[edge.child])))
    return found


def _convex(corners: Vector, faces: Faces) -> coal.Convex:
    vertices = coal.StdVec_Vec3s()
    vertices.extend(list(corners))
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(*face) for face in faces.tolist()])
    return coal.Convex(vertices, triangles)


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


def _near_geoms(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.int64] | None:
    """(n, 2) geoms near each other that MuJoCo would let collide; None where they are too many."""
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(colliding & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)))
    near = near_pairs(data.geom_xpos[geoms], model.geom_rbound[geoms], _NEAR)
    return None if near is None else _allowed(model, geoms[near])


def _allowed(model: mujoco.MjModel, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Those pairs of geoms that MuJoCo would let collide."""
    contype, conaffinity = model.geom_contype, model.geom_conaffinity
    first, second = pairs[:, 0], pairs[:, 1]
    a, b = model.geom_bodyid[first], model.geom_bodyid[second]
    weld, parent = model.body_weldid, model.body_parentid
    above_a, above_b = weld[parent[weld[a]]], weld[parent[weld[b]]]
    family = (weld[a] == weld[b]) | (weld[a] == above_b) | (weld[b] == above_a)
    signature = (np.minimum(a, b).astype(np.int64) << 16) + np.maximum(a, b)
    excluded = np.isin(signature, model.exclude_signature)
    masked = (contype[first] & conaffinity[second]) | (contype[second] & conaffinity[first])
    kept: NDArray[np.int64] = pairs[~family & ~excluded & (masked != 0)]
    return kept


def _findings(asset: Asset, result: PoseResult) -> Iterator[Finding]:
    for near in result.near:
        if near.distance >= -_TOUCH:
            continue
        body = asset.body.get(near.second)
        shapes = asset.shapes_of(near.second)
        place = shapes[0].place if shapes else (body.place if body else asset.place)
        agreed = result.engine == "coal" or (
            (near.by_coal is not None)
            and abs(near.by_coal - near.distance) < max(_AGREE, 0.05 * abs(near.distance))
        )
        yield Finding(
            "meshes.self_collision",
            "warning",
            place,
            f"links '{near.first}' and '{near.second}'",
            f"their collision shapes overlap at the pose '{result.name}'"
            + ("" if agreed else "; MuJoCo and coal disagree about the depth"),
            near.distance,
            "m",
            "a distance of 0 or more at a pose that the robot can take"
            + (f"; coal computes {near.by_coal:.4g} m" if near.by_coal is not None else ""),
            "a simulator pushes the two apart from the first step",
            "shrink one of the shapes, or declare that the pair never collides",
        )
    if result.pairs is None:
        yield _unknown(
            asset,
            f"at the pose '{result.name}' more than {MOST_CANDIDATES} pairs of shapes are near "
            "each other",
            _GOLDEN,
        )
    elif result.pairs > result.looked_at:
        yield _unknown(
            asset,
            f"at the pose '{result.name}' {result.pairs} pairs of shapes may be near each other; "
            f"the {result.looked_at} with the smallest gap between their bounding spheres were "
            "measured",
            _GOLDEN,
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
                    "distance": {"value": near.distance, "unit": "m", "by": result.engine},
                    "check": {"value": near.by_coal, "unit": "m", "by": "coal"},
                }
                for near in result.near[:100]
            ],
        }
        for result in results
    ]
