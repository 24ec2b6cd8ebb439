"""Calibration targets with a printed pattern: their fields and the positions of their corners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.calibration.boards.opencv import opencv
from pytest_twin.errors import SpecError

Kind = Literal["charuco", "chessboard", "apriltag_grid"]

KINDS: tuple[Kind, ...] = ("charuco", "chessboard", "apriltag_grid")
"""Kinds of targets that can be detected in images."""

_MOST_SQUARES = 100
"""Largest number of rows or columns of a target."""
_FIELDS: Mapping[str, tuple[str, ...]] = {
    "charuco": ("squares", "square", "marker", "dictionary"),
    "chessboard": ("squares", "square"),
    "apriltag_grid": ("squares", "square", "marker", "dictionary"),
}


@dataclass(frozen=True, slots=True)
class Target:
    """A flat calibration board.

    The board's frame has its origin at the outer corner of the first square or tag, x along the
    first row and y towards the next row. The corners of a ``charuco`` and a ``chessboard`` are
    those between squares. A ``charuco`` and a ``chessboard`` have y down the page and z into it,
    as OpenCV has them. The corners of an ``apriltag_grid`` are the four of each tag.

    The first square of a ``chessboard`` is dark. Where a half turn leaves its colours unchanged
    (columns and rows both even or both odd), x is assumed to point to the right of the image. Where
    robot poses are known, ``cameras.half_turn`` corrects this for boards that are turned by more
    than 90 degrees.

    Tags of an ``apriltag_grid`` are numbered from 0 along the rows. Whether the rows go down the
    page (OpenCV's ``GridBoard``) or up (Kalibr's AprilGrid), and how the tags are turned on the
    page, is found from the image. With rows that go up, y points up the page and z out of it.

    Attributes:
        squares: columns and rows of squares (of tags for an ``apriltag_grid``).
        square: edge of a square, m; for an ``apriltag_grid`` the distance from one tag to the
            next, which is the tag's edge and the gap together.
        marker: edge of a marker or tag, m; 0 for a ``chessboard``.
        dictionary: OpenCV's name of the markers' dictionary; empty for a ``chessboard``.
    """

    kind: Kind
    squares: tuple[int, int]
    square: float
    marker: float = 0.0
    dictionary: str = ""

    @property
    def corners(self) -> int:
        """Number of corners of the board."""
        columns, rows = self.squares
        return 4 * columns * rows if self.kind == "apriltag_grid" else (columns - 1) * (rows - 1)

    def board_points(self) -> FloatArray:
        """(corners, 3) positions in the board's frame, m; corner ids are the indices.

        The four corners of a tag are consecutive: first the one nearest to the origin, then the one
        along x, then the others in the same sense of rotation.
        """
        columns, rows = self.squares
        if self.kind == "apriltag_grid":
            tags = self.square * _grid(columns, rows)
            edge = self.marker * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            flat = (tags[:, None, :] + edge).reshape(-1, 2)
        else:
            flat = self.square * (1.0 + _grid(columns - 1, rows - 1))
        return np.column_stack([flat, np.zeros(len(flat))])


def _grid(columns: int, rows: int) -> FloatArray:
    """(columns * rows, 2) column and row of each grid position, row by row."""
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def make_target(data: Mapping[str, Any]) -> Target:
    """Build the target that the field ``target:`` of a plan describes.

    Raises:
        SpecError: a field is missing or does not describe a board that can be found in images.
    """
    kind = data.get("kind")
    if kind not in KINDS:
        raise SpecError(
            "this kind of target is not found in images",
            where="target.kind",
            value=kind,
            expected=", ".join(KINDS),
        )
    for name in _FIELDS[kind]:
        if name not in data:
            raise SpecError(
                "a field is missing", where=f"target.{name}", expected=_meaning(kind, name)
            )
    squares = tuple(data["squares"])
    fewest = 1 if kind == "apriltag_grid" else 3
    if len(squares) != 2 or not all(
        isinstance(n, int) and fewest <= n <= _MOST_SQUARES for n in squares
    ):
        raise SpecError(
            "not a usable number of squares",
            where="target.squares",
            value=list(squares),
            expected=f"columns and rows, {fewest} to {_MOST_SQUARES} each",
        )
    square, marker = float(data["square"]), float(data.get("marker", 0.0))
    dictionary = str(data.get("dictionary", ""))
    if not 0.0 < square < np.inf:
        raise SpecError(
            "not a length", where="target.square", value=square, unit="m", expected="above 0 m"
        )
    if kind == "chessboard":
        return Target("chessboard", (squares[0], squares[1]), square)
    if not 0.0 < marker < square:
        raise SpecError(
            "the marker does not fit into its square",
            where="target.marker",
            value=marker,
            unit="m",
            expected=f"above 0 and below square, {square} m",
        )
    if dictionary not in dictionaries():
        raise SpecError(
            "unknown dictionary of markers",
            where="target.dictionary",
            value=dictionary,
            expected=f"one of {', '.join(dictionaries())}",
        )
    return Target(kind, (squares[0], squares[1]), square, marker, dictionary)


def dictionaries() -> tuple[str, ...]:
    """OpenCV's names of its marker dictionaries."""
    return tuple(sorted(name for name in dir(opencv().aruco) if name.startswith("DICT_")))


def _meaning(kind: str, name: str) -> str:
    tags = kind == "apriltag_grid"
    return {
        "squares": "[columns, rows] of tags" if tags else "[columns, rows] of squares",
        "square": "distance from one tag to the next [m]" if tags else "edge of a square [m]",
        "marker": "edge of a tag [m]" if tags else "edge of a marker [m]",
        "dictionary": "DICT_APRILTAG_36h11 or another dictionary of OpenCV",
    }[name]
