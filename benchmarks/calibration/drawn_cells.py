"""Random calibration cells: the files that a user would have, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation
from simulated import (
    DICTIONARY,
    FOCAL_PX,
    HEIGHT,
    INTRINSICS,
    MARKER_M,
    SQUARE_M,
    SQUARES,
    WIDTH,
    Array,
    Robot,
    board_images,
    draw_robot,
    flange_poses,
    noisy,
    rigid,
)

KINDS = {
    "arm with joint zeros": 50,
    "given flange poses": 10,
    "two clocks": 10,
    "images": 10,
    "one axis": 7,
    "one plane": 6,
    "nearly unturned": 7,
}
"""Kinds of cells and their number in a hundred."""

DEGENERATE = ("one axis", "one plane", "nearly unturned")

ACCEPT = 3.0
"""Accepted error, as a multiple of the noise of the observations."""

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass
class Cell:
    """One cell on disk.

    Attributes:
        kind: one of ``KINDS``.
        plan: path of ``calibration.yaml``.
        mount: ``hand`` or ``world``.
        transforms: record -> true (4, 4), m.
        scalars: ``record.name`` -> true value, rad, s or px.
        noise: standard deviation of each coordinate of the measured positions, m.
        outliers: ids of the observations that are wrong.
    """

    kind: str
    plan: Path
    mount: str
    transforms: dict[str, Array] = field(default_factory=dict)
    scalars: dict[str, float] = field(default_factory=dict)
    noise: float = 0.0
    outliers: frozenset[str] = frozenset()


def kind_of(seed: int) -> str:
    """Return the kind of a seed; a hundred consecutive seeds have the numbers of ``KINDS``."""
    order = [kind for kind, count in KINDS.items() for _ in range(count)]
    return str(np.random.default_rng(0).permutation(order)[seed % len(order)])


def make(seed: int, folder: Path, kind: str | None = None) -> Cell:
    """Draw the cell of a seed and write its files into a new folder."""
    rng = np.random.default_rng([seed, 55])
    folder.mkdir(parents=True)
    kind = kind or kind_of(seed)
    mount = str(rng.choice(["hand", "world"]))
    if kind == "two clocks":
        return _two_clocks(rng, folder, mount)
    if kind == "images":
        return _images(rng, folder, mount)
    return _poses(rng, folder, mount, kind)


def _poses(rng: np.random.Generator, folder: Path, mount: str, kind: str) -> Cell:
    robot = draw_robot(rng, int(rng.integers(4, 8)))
    count = len(robot.joints)
    rows = int(rng.integers(14, 50))
    place = float(10 ** rng.uniform(-4.5, -2.5))
    turn = place * float(rng.uniform(0.5, 4.0))
    readings = rng.uniform(-1.3, 1.3, (rows, count))
    zeros = np.zeros(count)
    estimate = ["hand_eye", "base_world" if mount == "hand" else "robot_world"]
    with_robot = kind != "given flange poses"
    if kind == "arm with joint zeros":
        # The zeros of the first and last joint cannot be distinguished from base and camera poses.
        zeros[1:-1] = rng.normal(0.0, 0.02, count - 2)
        estimate = ["joint_zeros", *estimate]
    elif kind == "one axis":
        moving = int(rng.integers(count))
        readings[:, np.arange(count) != moving] = readings[0, np.arange(count) != moving]
    elif kind == "one plane":
        # Joints 2 and 3 are parallel: all poses lie in one plane.
        fixed = [at for at in range(count) if at not in (1, 2)]
        readings[:, fixed] = readings[0, fixed]
    elif kind == "nearly unturned":
        readings = readings[0] + rng.uniform(-1.0, 1.0, (rows, count)) * 1e-3 / np.sqrt(count)
        with_robot = bool(rng.random() < 0.5)
    if kind in DEGENERATE:
        turn = min(turn, 0.005)
    flange = flange_poses(robot, readings + zeros)
    if kind == "nearly unturned" and not with_robot:
        # Hand-guided motion: large translations and hardly any rotation.
        flange[:, :3, 3] += rng.uniform(-0.3, 0.3, (rows, 3))
    mounted, world = _frames(rng)
    seen = noisy(rng, _seen(flange, mounted, world, mount), place, turn)
    wrong: list[int] = []
    if kind in ("arm with joint zeros", "given flange poses") and rng.random() < 1 / 3:
        wrong = sorted(rng.choice(rows, max(rows // 10, 1), replace=False).tolist())
        for row in wrong:
            seen[row] = seen[row] @ rigid(rng.normal(0.0, 0.3, 3), rng.normal(0.0, 0.1, 3))
    cell = Cell(kind, folder / "calibration.yaml", mount, noise=place)
    cell.outliers = frozenset(str(row) for row in wrong)
    _truth(cell, mounted, world)
    if "joint_zeros" in estimate:
        inner = zip(robot.joints[1:-1], zeros[1:-1], strict=True)
        cell.scalars = {f"joint_zeros.{name}": float(value) for name, value in inner}
    columns: dict[str, Any] = {"camera_from_target": seen}
    if not with_robot:
        columns["flange"] = flange
        robot = None  # type: ignore[assignment]
    _write(cell, estimate, robot, readings, columns, place, turn)
    return cell


def _images(rng: np.random.Generator, folder: Path, mount: str) -> Cell:
    robot = draw_robot(rng, 6)
    place, turn = 2e-4, 4e-4
    rows = 18
    seen = np.array(
        [
            rigid(
                np.r_[rng.uniform(-0.55, 0.55, 2), rng.uniform(-1.5, 1.5)],
                np.r_[rng.uniform(-0.06, 0.06, 2), rng.uniform(0.3, 0.55)],
            )
            for _ in range(rows)
        ]
    )
    # The centre of the board, not its corner, is in the centre of the image.
    middle = rigid(np.zeros(3), -SQUARE_M * np.array([*SQUARES, 0.0]) / 2.0)
    seen = seen @ middle
    mounted, world = _frames(rng)
    if mount == "hand":
        flange = world @ np.linalg.inv(seen) @ np.linalg.inv(mounted)
    else:
        flange = world @ seen @ np.linalg.inv(mounted)
    (folder / "images").mkdir()
    names = []
    for row, image in enumerate(board_images(seen)):
        grain = rng.normal(0.0, 2.0, image.shape)
        names.append(f"images/{row}.png")
        cv2.imwrite(str(folder / names[-1]), np.clip(image + grain, 0.0, 255.0).astype(np.uint8))
    cell = Cell("images", folder / "calibration.yaml", mount, noise=place)
    _truth(cell, mounted, world)
    cell.scalars = {f"intrinsics.{name}": value for name, value in INTRINSICS.items()}
    estimate = ["intrinsics", "hand_eye", "base_world" if mount == "hand" else "robot_world"]
    columns = {"image": names, "flange": noisy(rng, flange, place, turn)}
    _write(cell, estimate, None, np.zeros((rows, 0)), columns, 1e-3, 2e-3)
    del robot
    return cell


def _two_clocks(rng: np.random.Generator, folder: Path, mount: str) -> Cell:
    robot = draw_robot(rng, 6)
    offset = float(rng.uniform(-0.2, 0.2))
    place, turn = 1e-3, 2e-3
    waves = rng.uniform(0.1, 0.6, (6, 3)), rng.uniform(0.0, 6.3, (6, 3)), rng.normal(0, 0.4, (6, 3))

    def positions(time: Array) -> Array:
        angle = 2.0 * np.pi * waves[0] * time[:, None, None] + waves[1]
        return np.asarray((waves[2] * np.sin(angle)).sum(axis=2))

    mounted, world = _frames(rng)
    hand = np.arange(0.0, 30.0, 0.01)
    camera = np.arange(1.0, 29.0, 1.0 / 30.0) + rng.normal(0.0, 1e-3, 840)
    streams = {
        "hand": (hand, noisy(rng, flange_poses(robot, positions(hand)), 1e-4, 2e-4)),
        # A time of the hand's clock is the stamp of the camera's clock plus the offset.
        "camera": (
            camera - offset,
            noisy(rng, _seen(flange_poses(robot, positions(camera)), mounted, world, mount),
                  place, turn),
        ),
    }  # fmt: skip
    for name, (time, poses) in streams.items():
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        table = np.column_stack([time, poses[:, :3, 3], quaternions])
        np.savetxt(
            folder / f"{name}.csv", table, fmt="%.12g", delimiter=",", comments="",
            header="t,x,y,z,qx,qy,qz,qw",
        )  # fmt: skip
    cell = Cell("two clocks", folder / "calibration.yaml", mount, noise=place)
    _truth(cell, mounted, world)
    cell.scalars = {"time_offset": offset}
    estimate = ["time_offset", "hand_eye", "base_world" if mount == "hand" else "robot_world"]
    files = {"streams": {"hand": "hand.csv", "camera": "camera.csv"}}
    _plan(cell, estimate, files, place, turn)
    return cell


def _frames(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the carried body's pose in the flange, and the fixed body's pose in the base."""
    mounted = rigid(
        Rotation.random(random_state=int(rng.integers(2**31))).as_rotvec(),
        rng.uniform(-0.1, 0.1, 3),
    )
    world = rigid(
        Rotation.random(random_state=int(rng.integers(2**31))).as_rotvec(),
        rng.uniform(-0.8, 0.8, 3),
    )
    return mounted, world


def _seen(flange: Array, mounted: Array, world: Array, mount: str) -> Array:
    """(rows, 4, 4) ``camera_from_target``."""
    if mount == "hand":
        return np.linalg.inv(flange @ mounted) @ world
    return np.linalg.inv(world) @ flange @ mounted


def _truth(cell: Cell, mounted: Array, world: Array) -> None:
    if cell.mount == "hand":
        cell.transforms = {"hand_eye": mounted, "base_world": np.linalg.inv(world)}
    else:
        cell.transforms = {"hand_eye": world, "robot_world": world}


def _write(
    cell: Cell,
    estimate: list[str],
    robot: Robot | None,
    readings: Array,
    columns: dict[str, Any],
    place: float,
    turn: float,
) -> None:
    folder = cell.plan.parent
    header, cells = ["id"], [[str(row) for row in range(len(readings))]]
    if robot is not None:
        header += [f"joint.{name}" for name in robot.joints]
        cells += [[repr(float(v)) for v in column] for column in readings.T]
        (folder / "robot.xml").write_text(robot.text)
    for name, values in columns.items():
        if name == "image":
            header.append(name)
            cells.append(list(values))
            continue
        header += [f"{name}.{part}" for part in _POSE]
        quaternions = np.roll(Rotation.from_matrix(values[:, :3, :3]).as_quat(), 1, axis=1)
        table = np.column_stack([values[:, :3, 3], quaternions])
        cells += [[repr(float(v)) for v in column] for column in table.T]
    lines = [",".join(header), *(",".join(row) for row in zip(*cells, strict=True))]
    (folder / "observations.csv").write_text("\n".join(lines) + "\n")
    files: dict[str, Any] = {"observations": "observations.csv"}
    if robot is not None:
        files["robot"] = "robot.xml"
    if "image" in columns:
        files["target"] = {
            "kind": "charuco", "squares": list(SQUARES), "square": SQUARE_M, "marker": MARKER_M,
            "dictionary": DICTIONARY,
        }  # fmt: skip
    _plan(cell, estimate, files, place, turn)


def _plan(
    cell: Cell, estimate: list[str], files: dict[str, Any], place: float, turn: float
) -> None:
    stated = {
        "calibration": "cell",
        "flange": "flange",
        "estimate": estimate,
        "camera": {"mount": cell.mount},
        "hold_out": {"fraction": 0.25, "seed": 1},
        "accept": {"translation": ACCEPT * place, "rotation": ACCEPT * turn},
        **files,
    }
    cell.plan.write_text(yaml.safe_dump(stated, sort_keys=False))


__all__ = ["DEGENERATE", "FOCAL_PX", "HEIGHT", "KINDS", "WIDTH", "Cell", "kind_of", "make"]
