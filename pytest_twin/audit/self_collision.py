"""Compute distances between collision shapes at declared poses, with MuJoCo and coal."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import coal
import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.audit.asset import Asset, Vector
from pytest_twin.audit.broad_phase import MOST_CANDIDATES, near_pairs
from pytest_twin.audit.finding import Finding, finding_of
from pytest_twin.audit.geometry import Faces, Geometry
from pytest_twin.errors import ModelError, TwinError
from pytest_twin.realization import load
from pytest_twin.realization.coal_hull import convex_hull
from pytest_twin.realization.collision import Shapes
from pytest_twin.realization.collision_filter import (
    are_excluded,
    are_one_or_linked,
    have_matching_masks,
)
from pytest_twin.realization.model import Realization

BASE_POSE = "zeros, within the ranges"
_NEAR = 0.05
"""m: pairs farther apart than this are not listed."""
_MOST_PAIRS = 1000
"""Largest number of pairs per pose whose distance is computed, nearest bounding spheres first."""
_MOST_POSES = 20
"""Largest number of declared poses that are evaluated."""
_MOST_SHAPES = 20_000
"""Largest number of collision shapes in a model; the broad phase then takes a few seconds."""
_TOUCH = 1e-3
"""m: larger overlaps are not explained by rounded origins and hulls of meshes."""
_AGREE = 1e-4
"""m: largest difference between the two engines."""
_GOLDEN = "add a golden of kind collision_distance for the pairs of bodies that can meet"


@dataclass(frozen=True, slots=True)
class NearPair:
    """Two bodies near each other.

    Attributes:
        distance: distance by MuJoCo, m, negative for an overlap.
        by_coal: distance by coal, m; None if coal computed none.
    """

    first: str
    second: str
    distance: float
    by_coal: float | None


@dataclass(frozen=True, slots=True)
class PoseResult:
    """Distances at one pose.

    Attributes:
        values: joint -> rad or m.
        near: pairs of near bodies, the nearest first.
        checked_pairs: number of pairs of shapes whose distance was computed.
        pairs: number of pairs of shapes with near bounding spheres; None if they exceed the
            limit of the broad phase, and no distance was computed.
        engine: engine that computed the distances of ``near``.
    """

    name: str
    values: Mapping[str, float]
    near: tuple[NearPair, ...]
    checked_pairs: int
    pairs: int | None
    engine: str = "MuJoCo"

    @property
    def overlapping(self) -> frozenset[str]:
        """Return the bodies that overlap with another."""
        return frozenset(name for near in self.overlaps for name in (near.first, near.second))

    @property
    def overlaps(self) -> tuple[NearPair, ...]:
        """Return the pairs that overlap by more than ``_TOUCH``."""
        return tuple(near for near in self.near if near.distance < -_TOUCH)


def poses(asset: Asset, declared: Mapping[str, Mapping[str, float]]) -> dict[str, dict[str, float]]:
    """Return pose -> joint -> rad or m: the base pose, keyframes and declared poses."""
    base = base_pose(asset)
    found = {BASE_POSE: base}
    for source in (asset.poses, declared):
        for name, values in source.items():
            if len(found) <= _MOST_POSES:
                known = {joint: v for joint, v in values.items() if joint in base}
                found[name] = base | known
    return found


def base_pose(asset: Asset) -> dict[str, float]:
    """Return joint -> rad or m: zeros clipped to the ranges, followers at their leaders' values."""
    base = {}
    for joint in asset.joints:
        if joint.is_scalar:
            value = joint.reference
            if joint.is_limited and joint.lower is not None and joint.upper is not None:
                value = min(max(value, joint.lower), joint.upper)
            base[joint.name] = value
    return with_followers(asset, base)


def with_followers(asset: Asset, values: Mapping[str, float]) -> dict[str, float]:
    """Add the values of mimic joints, rad or m."""
    found = dict(values)
    for mimic in asset.mimics:
        if mimic.follower in found and mimic.leader in found:
            found[mimic.follower] = mimic.multiplier * found[mimic.leader] + mimic.offset
    return found


def measure(
    asset: Asset, geometry: Geometry, declared: Mapping[str, Mapping[str, float]]
) -> tuple[list[PoseResult], list[Finding]]:
    """Compute the distances at every pose, and the findings about them.

    MuJoCo compiles URDF and MJCF and computes the distances; coal confirms those of near pairs. For
    a USD stage, or a model that does not compile, coal alone computes distances between the convex
    hulls of the shapes that could be read.
    """
    if not any(shape.role == "collision" for shape in asset.shapes):
        return [], [_unknown(asset, "it has no collision shape", "add collision shapes from CAD")]
    realization = None
    if asset.kind != "usd":
        # Coal can measure hulls even if the model does not compile.
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
    hulls: Hulls | None = None
    results = []
    for name, values in poses(asset, declared).items():
        if realization is None or shapes is None:
            hulls = hulls or Hulls(asset, geometry)
            results.append(hulls.near(name, values))
        else:
            results.append(_distances_at(realization, shapes, name, values))
    return results, [finding for result in results for finding in _findings(asset, result)]


def _unknown(asset: Asset, why: str, settle: str) -> Finding:
    return finding_of(
        "meshes.distances_unknown",
        asset.place,
        f"robot '{asset.name}'",
        title=f"distances between collision shapes were not computed: {why}",
        settle=settle,
    )


def _distances_at(
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
    found: dict[tuple[str, str], NearPair] = {}
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


class Hulls:
    """Convex hulls of an asset's collision shapes, computed once for all poses."""

    def __init__(self, asset: Asset, geometry: Geometry) -> None:
        self.asset = asset
        self._bodies: list[str] = []
        self._corners: list[Vector] = []
        self._faces: list[Faces] = []
        self._made: dict[int, coal.Convex] = {}
        for shape in asset.shapes:
            hull = geometry.hull(shape) if shape.role == "collision" else None
            if hull is not None and shape.body in asset.drawn:
                self._bodies.append(shape.body)
                self._corners.append(hull[0] @ shape.rotation.T + shape.position)
                self._faces.append(hull[1])

    def near(self, name: str, values: Mapping[str, float], *, joined: bool = False) -> PoseResult:
        """Compute distances between convex hulls with coal, at one pose.

        Args:
            values: joint -> rad or m.
            joined: include links that are fixed to each other or meet at a joint.
        """
        places = self.asset.at(values)
        boxes = []
        for body, corners in zip(self._bodies, self._corners, strict=True):
            position, rotation = places[body]
            placed = corners @ rotation.T + position
            boxes.append((placed.min(axis=0), placed.max(axis=0)))
        low = np.array([box[0] for box in boxes]).reshape(-1, 3)
        high = np.array([box[1] for box in boxes]).reshape(-1, 3)
        pairs = near_pairs((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2, _NEAR)
        if pairs is None:
            return PoseResult(name, dict(values), (), 0, None, "coal")
        at, other = pairs.T
        gaps = np.maximum(low[at] - high[other], low[other] - high[at]).max(axis=1, initial=-np.inf)
        near = [
            int(i)
            for i in np.argsort(gaps, kind="stable")
            if gaps[i] < _NEAR and self._is_counted(int(at[i]), int(other[i]), joined)
        ]
        found: dict[tuple[str, str], NearPair] = {}
        for index in near[:_MOST_PAIRS]:
            pair = int(at[index]), int(other[index])
            distance = self._distance(pair, places)
            first, second = sorted(self._bodies[one] for one in pair)
            known = found.get((first, second))
            if distance < _NEAR and (known is None or distance < known.distance):
                found[first, second] = NearPair(first, second, distance, None)
        return PoseResult(
            name,
            dict(values),
            tuple(sorted(found.values(), key=lambda n: n.distance)),
            min(len(near), _MOST_PAIRS),
            len(near),
            "coal",
        )

    def _is_counted(self, first: int, second: int, joined: bool) -> bool:
        """Whether the distance of two shapes is computed."""
        bodies = self._bodies[first], self._bodies[second]
        if joined:
            return bodies[0] != bodies[1]
        return frozenset(self.asset.group[body] for body in bodies) not in self._adjacent

    @cached_property
    def _adjacent(self) -> set[frozenset[str]]:
        """Return pairs of rigid groups that are the same or share a joint."""
        group = self.asset.group
        found = {frozenset((top,)) for top in group.values()}
        for edge in self.asset.in_order():
            found.add(frozenset((group[edge.parent], group[edge.child])))
        return found

    def _distance(
        self, pair: tuple[int, int], places: Mapping[str, tuple[Vector, Vector]]
    ) -> float:
        """Return the distance of two shapes, m; negative for an overlap."""
        request = coal.DistanceRequest()
        request.enable_signed_distance = True
        placed: list[object] = []
        for one in pair:
            if one not in self._made:
                self._made[one] = convex_hull(self._corners[one], self._faces[one])
            position, rotation = places[self._bodies[one]]
            placed += [self._made[one], coal.Transform3s(rotation, position)]
        return float(coal.distance(*placed, request, coal.DistanceResult()))


def _near(
    realization: Realization, shapes: Shapes, data: mujoco.MjData, first: int, second: int
) -> NearPair | None:
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
    return NearPair(low, high, distance, by_coal if np.isfinite(by_coal) else None)


def _near_geoms(model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.int64] | None:
    """Return (n, 2) near geoms whose collision MuJoCo allows; None if there are too many."""
    colliding = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    geoms = np.flatnonzero(colliding & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)))
    near = near_pairs(data.geom_xpos[geoms], model.geom_rbound[geoms], _NEAR)
    return None if near is None else _allowed(model, geoms[near])


def _allowed(model: mujoco.MjModel, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the pairs of geoms whose collision MuJoCo allows."""
    geoms = pairs[:, 0], pairs[:, 1]
    bodies = model.geom_bodyid[geoms[0]], model.geom_bodyid[geoms[1]]
    kept_apart = are_one_or_linked(model, *bodies) | are_excluded(model, *bodies)
    allowed: NDArray[np.int64] = pairs[~kept_apart & have_matching_masks(model, *geoms)]
    return allowed


def _findings(asset: Asset, result: PoseResult) -> Iterator[Finding]:
    for near in result.overlaps:
        body = asset.body.get(near.second)
        shapes = asset.shapes_of(near.second)
        place = shapes[0].place if shapes else (body.place if body else asset.place)
        agreed = result.engine == "coal" or (
            (near.by_coal is not None)
            and abs(near.by_coal - near.distance) < max(_AGREE, 0.05 * abs(near.distance))
        )
        yield finding_of(
            "meshes.self_collision",
            place,
            f"links '{near.first}' and '{near.second}'",
            near.distance,
            title=f"their collision shapes overlap at the pose '{result.name}'"
            + ("" if agreed else "; MuJoCo and coal disagree about the depth"),
            expected="a distance of 0 or more at a pose that the robot can take"
            + (f"; coal computes {near.by_coal:.4g} m" if near.by_coal is not None else ""),
        )
    if result.pairs is None:
        yield _unknown(
            asset,
            f"at the pose '{result.name}' more than {MOST_CANDIDATES} pairs of shapes are near "
            "each other",
            _GOLDEN,
        )
    elif result.pairs > result.checked_pairs:
        yield _unknown(
            asset,
            f"at the pose '{result.name}' {result.pairs} pairs of shapes may be near each other; "
            f"the {result.checked_pairs} with the smallest gap between their bounding spheres were "
            "measured",
            _GOLDEN,
        )


def to_json(results: Sequence[PoseResult]) -> list[dict[str, object]]:
    """Return the results as JSON data."""
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
