"""Draw robots from ``ranges.json`` in the folder of this file. Requires numpy only.

    from sampler import Ranges

    robots = Ranges.load("ranges.json").draw(4096, seed=0)
    robots["elbow.viscous_friction"]        # (4096,) N*m*s/rad
    robots["fore.mass"]                     # (4096,) kg
    robots["fore.inertia"]                  # (4096, 3, 3) kg*m^2 about the centre, body axes

Values with the same index belong to one robot and are correlated as they were estimated. Draw a
robot once for each episode, and encoder noise for each sample.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import NormalDist

import numpy as np

NEVER_BEYOND = 8.0
"""Distance of the mean from a bound, in standard deviations, above which a double-precision draw
never reaches it."""
_below = np.vectorize(lambda x: 0.5 * math.erfc(-x / math.sqrt(2.0)), otypes=[float])
_quantile = np.vectorize(NormalDist().inv_cdf, otypes=[float])


class Ranges:
    """Joint distribution of the parameters that vary between robots.

    Args:
        document: the content of ``ranges.json``.
    """

    def __init__(self, document: dict) -> None:
        if document.get("schema") != 1:
            raise ValueError("expected ranges.json of pytest-twin randomize, schema 1")
        self.document = document
        self.coordinates = document["coordinates"]
        self.bodies = document["bodies"]
        values, vectors = np.linalg.eigh(np.array(document["correlation"], dtype=float))
        self._root = vectors * np.sqrt(values.clip(0.0))

    @classmethod
    def load(cls, path: str | Path | None = None) -> Ranges:
        """Load a file; by default the one in the folder of this file."""
        path = path or Path(__file__).with_name("ranges.json")
        return cls(json.loads(Path(path).read_text(encoding="utf-8")))

    def draw(self, count: int, seed: int | None = None) -> dict[str, np.ndarray]:
        """Draw robots; return name -> (count, ...) values in SI units.

        Args:
            count: number of robots.
            seed: seed of the random numbers.
        """
        random = np.random.default_rng(seed)
        normal = random.standard_normal((count, len(self.coordinates))) @ self._root.T
        found, inertial = {}, {}
        for column, one in enumerate(self.coordinates):
            values = _values(one, normal[:, column])
            (found if one["body"] is None else inertial)[one["name"]] = values
        for one in self.coordinates:
            if one["at_most"] is not None:  # as back-EMF, which is a part of the joint's damping
                limit = one["at_most"]
                most = limit["factor"] * found[limit["name"]] + limit["rest"]
                found[one["name"]] = np.minimum(found[one["name"]], most)
        for body in self.bodies:
            found |= _body(body, inertial, count)
        return found

    def noise(self, samples: int, seed: int | None = None) -> dict[str, np.ndarray]:
        """Draw encoder noise; return joint -> (samples,) independent values, rad or m."""
        random = np.random.default_rng(seed)
        return {one["joint"]: one["std"] * random.standard_normal(samples)
                for one in self.document["noise"]}  # fmt: skip

    def mujoco_fields(self, robots: dict[str, np.ndarray]) -> dict[str, dict[int, np.ndarray]]:
        """Return field of an ``mjModel`` -> index -> (count, ...) values, for the checked model.

        After writing them the model needs ``mj_setConst`` (or its counterpart in a simulator).
        """
        found: dict[str, dict[int, np.ndarray]] = {}
        kinds = {"viscous_friction": "dof_damping", "coulomb_friction": "dof_frictionloss",
                 "armature": "dof_armature"}  # fmt: skip
        for joint, dof in self.document["places"]["joints"].items():
            for kind, name in kinds.items():
                if f"{joint}.{kind}" in robots:
                    found.setdefault(name, {})[dof] = robots[f"{joint}.{kind}"]
        for body, index in self.document["places"]["bodies"].items():
            moments, axes = _principal(robots[f"{body}.inertia"])
            for name, values in (
                ("body_mass", robots[f"{body}.mass"]), ("body_ipos", robots[f"{body}.com"]),
                ("body_inertia", moments), ("body_iquat", _quaternion(axes)),
            ):  # fmt: skip
                found.setdefault(name, {})[index] = values
        return found


def _values(one: dict, normal: np.ndarray) -> np.ndarray:
    """Values of the normal distribution, truncated at the bounds that the coordinate has."""
    mean, std = one["mean"], one["std"]
    lower = -math.inf if one["lower"] is None else one["lower"]
    upper = math.inf if one["upper"] is None else one["upper"]
    low, high = (lower - mean) / std, (upper - mean) / std
    if low < -NEVER_BEYOND and high > NEVER_BEYOND:
        return mean + std * normal
    side = -1.0 if high < 0.0 else 1.0
    if side < 0.0:
        low, high = -high, -low
    beyond = float(_below(-high))
    above = beyond + _below(-side * normal) * (float(_below(-low)) - beyond)
    cut = mean - side * std * _quantile(np.clip(above, 1e-300, 1.0 - 2.0**-53))
    return np.clip(cut, np.finfo(float).tiny if lower == 0.0 else lower, upper)


def _body(body: dict, inertial: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Mass, centre and inertia of the pseudo-inertia R (A + S) R^T, with eigenvalues limited."""
    x = np.zeros((count, 10))
    for name, index in zip(body["coordinates"], body["index"], strict=True):
        x[:, index] = inertial[name]
    change = np.zeros((count, 4, 4))
    row, column = np.tril_indices(4, -1)
    change[:, row, column] = change[:, column, row] = x[:, 4:]
    change[:, np.arange(4), np.arange(4)] = x[:, :4]
    values, vectors = np.linalg.eigh(np.array(body["middle"]) + change)
    kept = np.sqrt(np.maximum(values, body["floor"]))
    side = np.array(body["root"]) @ (vectors * kept[:, None, :])
    last = side[:, 3]
    mass = np.einsum("ni,ni->n", last, last)
    com = np.einsum("nki,ni->nk", side[:, :3], last) / mass[:, None]
    rest = side[:, :3] - com[:, :, None] * last[:, None, :]
    second = rest @ np.swapaxes(rest, 1, 2)
    inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    name = body["name"]
    return {f"{name}.mass": mass, f"{name}.com": com, f"{name}.inertia": inertia}


def _principal(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) principal moments, none larger than the sum of the others, and (n, 3, 3) axes."""
    half = 0.5 * np.trace(inertia, axis1=1, axis2=2)
    second, axes = np.linalg.eigh(half[:, None, None] * np.eye(3) - inertia)
    second = second.clip(0.0)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return second[:, [1, 0, 0]] + second[:, [2, 2, 1]], axes


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """(n, 4) quaternions w x y z of (n, 3, 3) rotation matrices.

    They are eigenvectors of the largest eigenvalue (Bar-Itzhack, Journal of
    Guidance, Control, and Dynamics 23, 2000).
    """
    r = rotation
    k = np.zeros((len(r), 4, 4))
    k[:, 0, 0] = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    k[:, 1, 1] = r[:, 0, 0] - r[:, 1, 1] - r[:, 2, 2]
    k[:, 2, 2] = r[:, 1, 1] - r[:, 0, 0] - r[:, 2, 2]
    k[:, 3, 3] = r[:, 2, 2] - r[:, 0, 0] - r[:, 1, 1]
    k[:, 0, 1] = k[:, 1, 0] = r[:, 2, 1] - r[:, 1, 2]
    k[:, 0, 2] = k[:, 2, 0] = r[:, 0, 2] - r[:, 2, 0]
    k[:, 0, 3] = k[:, 3, 0] = r[:, 1, 0] - r[:, 0, 1]
    k[:, 1, 2] = k[:, 2, 1] = r[:, 0, 1] + r[:, 1, 0]
    k[:, 1, 3] = k[:, 3, 1] = r[:, 0, 2] + r[:, 2, 0]
    k[:, 2, 3] = k[:, 3, 2] = r[:, 1, 2] + r[:, 2, 1]
    _, vectors = np.linalg.eigh(k)
    found = vectors[:, :, 3]
    return found * np.where(found[:, :1] < 0.0, -1.0, 1.0)
