"""Compute distances of a robot's shapes and positions of its frames along a motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.excitation.approved_limits import ApprovedLimits
from pytest_twin.realization.collision import Shapes, enabled_pairs
from pytest_twin.realization.first_state import follow_joint_equalities
from pytest_twin.realization.model import Realization

GRID = 0.01
"""Poses within one cell of this size (rad or m in every joint) count as one: 1 cm at a reach of
1 m."""


@dataclass(frozen=True, slots=True)
class NearestPair:
    """The pair with the smallest distance relative to the required one.

    Attributes:
        pair: two bodies or geoms.
        distance: distance, m, negative for an overlap.
        required: smallest permitted distance, m.
    """

    pair: tuple[str, str]
    distance: float
    required: float
    at: int

    @property
    def spare(self) -> float:
        """Return the distance minus the required one, m."""
        return self.distance - self.required


@dataclass(frozen=True, slots=True)
class _GeomPair:
    names: tuple[str, str]
    geoms: tuple[int, int]
    required: float


class ClearanceChecker:
    """Checks of clearances and workspace boxes.

    Args:
        approved: smallest distances, boxes, moving joints; other joints are at the reference.
    """

    def __init__(self, realization: Realization, approved: ApprovedLimits) -> None:
        self._realization = realization
        self._model = realization.model
        self._data = mujoco.MjData(self._model)
        self._approved = approved
        self._joint_ids = [realization.joint_index(name) for name in approved.names]
        self._columns = self._model.jnt_qposadr[self._joint_ids]
        self._shapes = Shapes(realization)
        self._pairs = tuple(self._required_pairs())
        geoms = np.array([pair.geoms for pair in self._pairs], dtype=np.intp).reshape(-1, 2)
        radius = np.where(self._model.geom_rbound > 0.0, self._model.geom_rbound, np.inf)
        self._geoms = geoms
        self._reach = radius[geoms].sum(axis=1)
        self._required = np.array([pair.required for pair in self._pairs])

    @property
    def pairs(self) -> int:
        """Return the number of pairs of shapes that are checked."""
        return len(self._pairs)

    def place(self, position: FloatArray) -> mujoco.MjData:
        """Compute frames and shapes at one pose (j,), with joint equalities satisfied."""
        data = self._data
        data.qpos[:] = self._model.qpos0
        data.qpos[self._columns] = position
        follow_joint_equalities(self._model, data, set(self._joint_ids))
        mujoco.mj_kinematics(self._model, data)
        return data

    def nearest(self, positions: FloatArray) -> NearestPair | None:
        """Return the pair with the smallest spare distance over poses (n, j), or None."""
        least: NearestPair | None = None
        for at in distinct(positions):
            data = self.place(positions[at])
            bounds = self._spare_bounds(data)
            for index in np.argsort(bounds):
                if least is not None and bounds[index] > least.spare:
                    break
                pair = self._pairs[index]
                found = self._distance(data, pair)
                if least is None or found - pair.required < least.spare:
                    least = NearestPair(pair.names, found, pair.required, int(at))
        return least

    def too_near(self, position: FloatArray) -> list[NearestPair]:
        """Return the nearest shapes of all pairs that are too close at one pose (j,)."""
        data = self.place(position)
        found: dict[tuple[str, str], NearestPair] = {}
        for index in np.flatnonzero(self._spare_bounds(data) < 0.0):
            pair = self._pairs[index]
            one = NearestPair(pair.names, self._distance(data, pair), pair.required, 0)
            known = found.get(pair.names)
            if one.spare < 0.0 and (known is None or one.spare < known.spare):
                found[pair.names] = one
        return list(found.values())

    def is_clear(self, position: FloatArray) -> bool:
        """Whether one pose (j,) satisfies all distances and boxes."""
        data = self.place(position)
        for index in np.flatnonzero(self._spare_bounds(data) < 0.0):
            pair = self._pairs[index]
            if self._distance(data, pair) < pair.required:
                return False
        return all(spare >= 0.0 for spare, _ in self._spare_in_boxes(data))

    def spare(self, position: FloatArray, most: float) -> float:
        """Return the smallest spare distance of pairs and boxes at one pose (j,), m.

        Args:
            position: the pose, (j,), rad or m.
            most: upper bound of the result, m.
        """
        data = self.place(position)
        least = min((most, *(spare for spare, _ in self._spare_in_boxes(data))))
        bounds = self._spare_bounds(data)
        for index in np.argsort(bounds):
            if bounds[index] >= least:
                break
            pair = self._pairs[index]
            least = min(least, self._distance(data, pair) - pair.required)
        return least

    def least_box_spare(self, positions: FloatArray) -> tuple[float, str, int] | None:
        """Return the smallest distance of a frame to the sides of its box, m, negative outside.

        The frame and the index of the pose follow. The result is None without boxes."""
        least: tuple[float, str, int] | None = None
        if not self._approved.workspace:
            return None
        for at in distinct(positions):
            for spare, frame in self._spare_in_boxes(self.place(positions[at])):
                if least is None or spare < least[0]:
                    least = (spare, frame, int(at))
        return least

    def _spare_in_boxes(self, data: mujoco.MjData) -> Iterator[tuple[float, str]]:
        for box in self._approved.workspace:
            origin = self._realization.frame_pose(data, box.frame)[:3, 3]
            yield float(np.minimum(origin - box.lower, box.upper - origin).min()), box.frame

    def _spare_bounds(self, data: mujoco.MjData) -> FloatArray:
        """Return (pairs,) lower bounds of the spare distances from bounding spheres, m."""
        centres = data.geom_xpos[self._geoms]
        between = np.linalg.norm(centres[:, 0] - centres[:, 1], axis=1)
        return np.asarray(between - self._reach - self._required)

    def _distance(self, data: mujoco.MjData, pair: _GeomPair) -> float:
        """Return the signed distance of two shapes by coal, or MuJoCo if coal fails, m."""
        first, second = (frozenset({geom}) for geom in pair.geoms)
        found = self._shapes.distance_by_coal(data, first, second)
        return found if np.isfinite(found) else self._shapes.distance(data, first, second)

    def _required_pairs(self) -> Iterator[_GeomPair]:
        clearance = self._approved.clearance
        if clearance is None:
            return
        keep = 1.0 + self._approved.margin
        for names in enabled_pairs(self._realization):
            fixed = [self._stands_still(name) for name in names]
            own = clearance.pairs.get(names, clearance.pairs.get((names[1], names[0])))
            if own is None:
                if frozenset(names) in clearance.ignored or all(fixed) or self._are_adjacent(names):
                    continue
                own = clearance.to_environment if any(fixed) else clearance.between_links
            yield from self._geom_pairs(names, keep * own)
        stated = set(enabled_pairs(self._realization))
        for names, distance in clearance.pairs.items():
            if names not in stated and (names[1], names[0]) not in stated:
                yield from self._geom_pairs(names, keep * distance)

    def _geom_pairs(self, names: tuple[str, str], required: float) -> Iterator[_GeomPair]:
        first, second = (sorted(self._shapes.geoms(name)) for name in names)
        for a, b in product(first, second):
            yield _GeomPair(names, (a, b), required)

    def _body(self, name: str) -> int:
        geoms = self._shapes.geoms(name)
        return int(self._model.geom_bodyid[next(iter(geoms))])

    def _stands_still(self, name: str) -> bool:
        """Whether no approved joint moves a body."""
        moving = {int(self._model.jnt_bodyid[index]) for index in self._joint_ids}
        body = self._body(name)
        while body:
            if body in moving:
                return False
            body = int(self._model.body_parentid[body])
        return True

    def _are_adjacent(self, names: Sequence[str]) -> bool:
        """Whether a joint connects the two bodies, whose shapes may overlap there."""
        welds = [int(self._model.body_weldid[self._body(name)]) for name in names]
        above = [int(self._model.body_weldid[self._model.body_parentid[weld]]) for weld in welds]
        # Geoms of the world are surroundings; geoms of a base fixed to the world are not.
        if any(self._body(name) == 0 for name in names):
            return False
        return welds[0] == above[1] or welds[1] == above[0]


def distinct(positions: FloatArray) -> FloatArray:
    """Return indices of poses (n, j) in different cells of ``GRID``, in order."""
    cells = np.round(positions / GRID).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    return np.sort(first)
