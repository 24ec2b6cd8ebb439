"""Find pairs of shapes that may be near each other, without testing every pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pytest_twin.audit.asset import Vector

MOST_CANDIDATES = 1_000_000
"""Largest number of pairs: 16 MB of indices, and a second to sort them by their gap."""


def near_pairs(
    centres: Vector, radii: Vector, margin: float, *, most: int = MOST_CANDIDATES
) -> NDArray[np.int64] | None:
    """Return (m, 2) indices, the lower first, of bounding spheres with a gap below ``margin``.

    Spheres are sorted into classes whose radii differ by less than a factor of 2. For each pair of
    classes, a k-d tree of centres finds the pairs. The time grows with the number of shapes and of
    pairs found, not with the square of the number of shapes.

    Args:
        centres: (n, 3) centres in one frame, m.
        radii: (n,) radii, m.
        margin: largest gap, m.
        most: largest number of candidates.

    Returns:
        None if there are more than ``most`` candidates.
    """
    found = [np.zeros((0, 2), dtype=np.int64)]
    classes = np.floor(np.log2(np.maximum(radii, 1e-6))).astype(np.int64)
    members = [np.flatnonzero(classes == kind) for kind in np.unique(classes)]
    trees = [KDTree(centres[rows]) for rows in members]
    left = most
    for first in range(len(members)):
        for second in range(first, len(members)):
            mine, other = members[first], members[second]
            reach = float(radii[mine].max() + radii[other].max()) + margin
            # Within one class the tree returns each pair twice, and each shape paired with itself.
            count = int(trees[first].count_neighbors(trees[second], reach))
            left -= (count - len(mine)) // 2 if first == second else count
            if left < 0:
                return None
            if first == second:
                pairs = trees[first].query_pairs(reach, output_type="ndarray").astype(np.int64)
                rows = np.stack([mine[pairs[:, 0]], mine[pairs[:, 1]]], axis=1)
            else:
                near = trees[first].query_ball_tree(trees[second], reach)
                lengths = [len(hits) for hits in near]
                flat = np.array([hit for hits in near for hit in hits], dtype=np.int64)
                rows = np.stack([np.repeat(mine, lengths), other[flat]], axis=1)
            apart = np.linalg.norm(centres[rows[:, 0]] - centres[rows[:, 1]], axis=1)
            rows = rows[apart - radii[rows].sum(axis=1) < margin]
            found.append(np.sort(rows, axis=1))
    pairs = np.concatenate(found)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
