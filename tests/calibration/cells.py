"""Simulated cells: a robot with known errors, a camera, a target and the observations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pytest_twin.calibration.observations import Observations
from pytest_twin.calibration.plan import Accept, HoldOut, Plan, Priors
from pytest_twin.metrics.pose import inverse, rigid, rotation_of, rotation_vector
from pytest_twin.realization.serial_chain import SerialChain


def pose(rng: np.random.Generator, size: float = 0.3) -> np.ndarray:
    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    return rigid(turn, rng.uniform(-size, size, 3))


def arm(joints: int, rng: np.random.Generator) -> SerialChain:
    """A serial arm about 1 m long with revolute joints whose axes are not parallel."""
    placements, axes = [], []
    for at in range(joints):
        turn = Rotation.from_euler("x", [0.0, np.pi / 2, -np.pi / 2][at % 3 if at else 0])
        placements.append(rigid(turn.as_matrix(), [0.05, 0.05 * (at % 2), 1.0 / joints]))
        axes.append([0.0, 0.0, 1.0])
    return SerialChain(
        base="base",
        frame="flange",
        joints=tuple(f"j{at + 1}" for at in range(joints)),
        placements=np.array(placements),
        axes=np.array(axes),
        revolute=np.ones(joints, dtype=bool),
        end=rigid(np.eye(3), rng.uniform(0.0, 0.1, 3)),
        signs=np.ones(joints),
        offsets=np.zeros(joints),
    )


def forward(chain: SerialChain, values: np.ndarray) -> np.ndarray:
    """Flange poses (rows, 4, 4) by products of transforms, independent of the package."""
    poses = []
    for row in values:
        total = np.eye(4)
        for at, value in enumerate(row):
            turn = Rotation.from_rotvec(chain.axes[at] * value * chain.revolute[at])
            slide = chain.axes[at] * value * (not chain.revolute[at])
            total = total @ chain.placements[at] @ rigid(turn.as_matrix(), slide)
        poses.append(total @ chain.end)
    return np.array(poses)


def noisy(poses: np.ndarray, translation: float, rotation: float, rng: np.random.Generator):
    count = len(poses)
    turns = Rotation.from_rotvec(rng.normal(0.0, rotation, (count, 3))).as_matrix()
    found = poses.copy()
    found[:, :3, :3] = found[:, :3, :3] @ turns
    found[:, :3, 3] += rng.normal(0.0, translation, (count, 3))
    return found


@dataclass
class Cell:
    """True values and observations of one cell."""

    mounted: np.ndarray
    world: np.ndarray
    observations: Observations
    chain: SerialChain | None = None
    zeros: np.ndarray = field(default_factory=lambda: np.zeros(0))


def seen(flange: np.ndarray, mounted: np.ndarray, world: np.ndarray, mount: str) -> np.ndarray:
    if mount == "hand":
        return inverse(flange @ mounted) @ world
    return inverse(world) @ flange @ mounted


def flange_cell(
    rng: np.random.Generator,
    flange: np.ndarray,
    *,
    mount: str = "hand",
    translation: float = 5e-4,
    rotation: float = 1e-3,
) -> Cell:
    mounted, world = pose(rng, 0.1), pose(rng, 0.8)
    measured = noisy(seen(flange, mounted, world, mount), translation, rotation, rng)
    observations = Observations(
        ids=tuple(str(i) for i in range(len(flange))), flange=flange, camera_from_target=measured
    )
    return Cell(mounted, world, observations)


def joint_cell(
    rng: np.random.Generator,
    chain: SerialChain,
    rows: int,
    *,
    mount: str = "hand",
    zeros: np.ndarray | None = None,
    translation: float = 5e-4,
    rotation: float = 1e-3,
) -> Cell:
    count = len(chain.joints)
    zeros = np.zeros(count) if zeros is None else zeros
    readings = rng.uniform(-1.2, 1.2, (rows, count))
    cell = flange_cell(
        rng,
        forward(chain, readings + zeros),
        mount=mount,
        translation=translation,
        rotation=rotation,
    )
    observations = Observations(
        ids=cell.observations.ids,
        joints=dict(zip(chain.joints, readings.T, strict=True)),
        camera_from_target=cell.observations.camera_from_target,
    )
    return Cell(cell.mounted, cell.world, observations, chain, zeros)


def plan(*estimate: str, mount: str = "hand", **options: Any) -> Plan:
    """A calibration plan for observations in memory."""
    stated: dict[str, Any] = {
        "camera": {},
        "points": {},
        "given": {},
        "priors": Priors(),
        "hold_out": HoldOut(0.2, 0),
        "accept": Accept(),
    }
    return Plan(
        id="cell",
        path=Path("calibration.yaml"),
        robot=None,
        flange="flange",
        observations=(Path("observations.csv"),),
        streams={},
        estimate=estimate,
        mount=mount,
        target={},
        **(stated | options),
    )


def with_outliers(observations: Observations, rows: list[int], size: float) -> Observations:
    poses = observations.camera_from_target.copy()
    poses[rows, :3, 3] += size
    return replace(observations, camera_from_target=poses)


def truth_inside(found: dict[str, Any], record: str, truth: np.ndarray) -> list[bool]:
    """Whether each of the six intervals of a record contains the true (4, 4) transform."""
    stated = found["records"][record]
    transform, intervals = stated["transform"], stated["ci95"]
    turn = rotation_of(transform["quaternion_wxyz"]).T @ truth[:3, :3]
    values = [*truth[:3, 3], *rotation_vector(turn)]
    return [
        intervals[name][0] <= value <= intervals[name][1]
        for name, value in zip(("x", "y", "z", "rx", "ry", "rz"), values, strict=True)
    ]
