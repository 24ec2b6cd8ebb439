"""Resolve the poses of a spec: named, given by joint values, or drawn from a seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.fields import (
    POSITION_UNIT,
    known_name,
    quantity,
    spec_error,
)
from pytest_twin.checks.schemas import any_of, array, integer, mapping, quantity_field, table, text
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization import Realization


REFERENCE = "reference"
_DRAWS = 200  # largest number of draws for a coupled group
_ENDLESS = 1e3  # rad or m: a larger limit does not limit the joint
_GRID = 65  # number of values of a leading joint that are tested
_CLOSED = 1e-10  # largest residual of a closed loop, m or rad

POSE_SCHEMA: Mapping[str, Any] = any_of(
    text(minLength=1),
    table(
        {
            "name": text("Name in reports.", minLength=1),
            "joints": mapping(
                quantity_field(), "Joint -> position in rad or m, or with a unit, such as '90 deg'."
            ),
        },
        required=["joints"],
    ),
    description="'reference' (the model's reference configuration), the name of a keyframe of the "
    "model, or joint positions. Joints that are left out stay at the reference. Coupled (mimic) "
    "joints follow the joint that leads them.",
)
"""JSON Schema of one pose."""

POSES_SCHEMA: Mapping[str, Any] = array(
    any_of(
        *POSE_SCHEMA["anyOf"],
        table(
            {
                "seed": integer("Seed of the draw.", minimum=0),
                "count": integer("Number of poses to draw.", minimum=1, maximum=1000),
            },
            "Random poses within the joint limits. A joint without limits is drawn within half a "
            "turn or 1 m to each side. The poses are drawn once and then recorded in the spec.",
            required=["seed", "count"],
        ),
    ),
    "Poses to evaluate: named, given by joint positions, or drawn from a seed.",
    minItems=1,
    maxItems=1000,
)
"""JSON Schema of a list of poses."""


@dataclass(frozen=True, slots=True)
class Pose:
    """One configuration that satisfies the model's couplings.

    Attributes:
        name: name, unique within its golden; ``seed 7 #3`` for a drawn pose.
        joints: every hinge and slide joint of the model -> value, rad or m.
        drawn: recorded values of the independent joints of a drawn pose; None for other poses.
        qpos: (nq,) MuJoCo's coordinates; ball and free joints are at the reference.
    """

    name: str
    joints: Mapping[str, float]
    drawn: Mapping[str, float] | None
    qpos: FloatArray


def resolve_poses(
    golden: Golden,
    realization: Realization,
    *,
    moved: frozenset[str] | None = None,
) -> list[Pose]:
    """Return all poses of a golden, in order.

    Drawn poses come from the golden's ``expected.poses`` if recorded there, so that a changed
    joint range does not change recorded results.

    Args:
        golden: golden whose stimulus has ``poses`` of the form ``POSES_SCHEMA``.
        moved: joints to draw, together with joints coupled to them; None for all.

    Raises:
        SpecError: the model lacks a joint or keyframe, a value has a wrong unit, two poses have
            the same name, or no pose satisfies the couplings.
    """
    recorded = (golden.expected or {}).get("poses", {})
    solver = _Coupled(realization.model)
    poses: list[Pose] = []
    for number, entry in enumerate(golden.stimulus["poses"]):
        place = f"stimulus.poses.{number}"
        if isinstance(entry, Mapping) and "seed" in entry:
            seed = int(entry["seed"])
            for index in range(1, int(entry["count"]) + 1):
                name = f"seed {seed} #{index}"
                known = recorded.get(name)
                if known is not None and set(known) <= set(solver.joint_type):
                    drawn = {joint: float(value) for joint, value in known.items()}
                else:
                    drawn = solver.draw(golden, place, seed, index, moved)
                poses.append(solver.pose(golden, place, name, drawn, held=frozenset(), drawn=True))
        else:
            poses.append(_read_pose(golden, place, entry, number, solver))
    seen: set[str] = set()
    for pose in poses:
        if pose.name in seen:
            raise spec_error(
                golden,
                "stimulus.poses",
                "two poses have the same name",
                value=pose.name,
                expected="a different name for each pose",
            )
        seen.add(pose.name)
    return poses


def resolve_pose(golden: Golden, realization: Realization, entry: object, field: str) -> Pose:
    """Return one pose, given in the form ``POSE_SCHEMA``; raises as ``resolve_poses``."""
    return _read_pose(golden, field, entry, 0, _Coupled(realization.model))


def configuration(realization: Realization, values: Mapping[str, float]) -> FloatArray:
    """Return (nq,) coordinates with ``values`` (rad or m) and the joints coupled to them."""
    return _Coupled(realization.model).configuration(values)


class Configurations:
    """Joint values that a model's limits and couplings permit.

    Attributes:
        independent: joint that follows no other -> (lower, upper) of the values with which it
            and all its followers are within their limits, rad or m. A joint without such values
            is omitted and stays at the reference.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._solver = _Coupled(model)
        found = ((root, self._solver.span(root)) for root in self._solver.roots())
        self.independent: Mapping[str, tuple[float, float]] = {
            root: span for root, span in found if span is not None
        }

    def complete(self, values: Mapping[str, float]) -> dict[str, float] | None:
        """Return all hinge and slide joints, rad or m: ``values`` and the joints that follow.

        Returns:
            None if a closed loop of the model does not close, or a joint leaves its limits.
        """
        return self._solver.complete(values)


def recorded_poses(poses: list[Pose]) -> dict[str, dict[str, float]]:
    """Return the drawn poses, for ``expected.poses``."""
    return {pose.name: dict(pose.drawn) for pose in poses if pose.drawn is not None}


def joints_above(structure: Structure, bodies: Iterable[str]) -> frozenset[str]:
    """Return the joints on the chains from the world to ``bodies``."""
    above = {link for body in bodies for link in structure.ancestors(body)}
    return frozenset(joint for joint, body in structure.joint_body.items() if body in above)


def joints_to_give(realization: Realization, joints: Iterable[str]) -> frozenset[str]:
    """Return the independent hinge and slide joints that determine ``joints``.

    A follower is replaced by its leader; joints held by a constant are omitted."""
    solver = _Coupled(realization.model)
    roots = {solver.root(joint) for joint in joints if joint in solver.joint_type}
    return frozenset(root for root in roots if root is not None)


def keyframe_parts(golden: Golden, structure: Structure) -> frozenset[str]:
    """Return the ids of the keyframes that a golden's poses name."""
    entries = [*golden.stimulus.get("poses", []), golden.stimulus.get("pose")]
    names = [entry for entry in entries if isinstance(entry, str) and entry != REFERENCE]
    return frozenset().union(*(structure.keyframe(name) for name in names))


def _read_pose(golden: Golden, place: str, entry: object, number: int, solver: _Coupled) -> Pose:
    if isinstance(entry, str):
        values = {} if entry == REFERENCE else solver.keyframe(golden, place, entry)
        return solver.pose(golden, place, entry, values, held=None)
    if not isinstance(entry, Mapping):
        raise spec_error(golden, place, "not a pose", value=entry, expected="a name or joints")
    values = {}
    for joint, value in entry["joints"].items():
        at = f"{place}.joints.{joint}"
        known_name(golden, at, joint, solver.joint_type, "hinge or slide joint")
        values[joint] = quantity(golden, at, value, POSITION_UNIT[solver.joint_type[joint]])
    name = str(entry.get("name", f"pose {number + 1}"))
    return solver.pose(golden, place, name, values, held=frozenset(values))


class _Coupled:
    """Joint values of a model that satisfy its equality constraints."""

    def __init__(self, model: mujoco.MjModel) -> None:
        import mujoco

        self._mujoco = mujoco
        self._model = model
        types = {mujoco.mjtJoint.mjJNT_HINGE: "hinge", mujoco.mjtJoint.mjJNT_SLIDE: "slide"}
        self._joint = {
            name: i
            for i in range(model.njnt)
            if int(model.jnt_type[i]) in types and (name := str(model.joint(i).name))
        }
        self.joint_type = {name: types[int(model.jnt_type[i])] for name, i in self._joint.items()}
        self._names = {i: name for name, i in self._joint.items()}
        self._masters: dict[str, tuple[str | None, FloatArray]] = {}
        self._loops = False
        for i in range(model.neq):
            if not model.eq_active0[i]:
                continue
            first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
            if int(model.eq_type[i]) != int(mujoco.mjtEq.mjEQ_JOINT):
                self._loops = True
            elif first in self._names and (second < 0 or second in self._names):
                master = self._names[second] if second >= 0 else None
                self._masters[self._names[first]] = (master, model.eq_data[i, :5].copy())

    def keyframe(self, golden: Golden, place: str, name: str) -> dict[str, float]:
        model = self._model
        keys = {model.key(i).name: i for i in range(model.nkey)}
        known_name(golden, place, name, [REFERENCE, *keys], "pose or keyframe")
        qpos = model.key_qpos[keys[name]]
        return {joint: float(qpos[model.jnt_qposadr[i]]) for joint, i in self._joint.items()}

    def configuration(self, values: Mapping[str, float]) -> FloatArray:
        qpos: FloatArray = self._model.qpos0.copy()
        for joint, value in values.items():
            qpos[self._address(joint)] = value
        self._follow(qpos)
        return qpos

    def pose(
        self,
        golden: Golden,
        place: str,
        name: str,
        values: Mapping[str, float],
        *,
        held: frozenset[str] | None,
        drawn: bool = False,
    ) -> Pose:
        """Complete ``values`` with the joints that follow from them.

        ``held`` are the joints that closing a loop must not move. If it is None, loops are not
        closed, because the model's own poses are used unchanged.
        """
        qpos = self.configuration(values)
        if self._loops and held is not None:
            open_joints = self._close(qpos, held)
            if open_joints:
                raise spec_error(
                    golden,
                    place,
                    "no such pose: a closed loop of the model does not close there",
                    value=name,
                    expected="joint values that the model's equality constraints allow",
                )
        joints = {joint: float(qpos[self._address(joint)]) for joint in self._joint}
        return Pose(name, joints, dict(values) if drawn else None, qpos)

    def draw(
        self, golden: Golden, place: str, seed: int, index: int, moved: frozenset[str] | None
    ) -> dict[str, float]:
        """Draw the independent joints of one random pose.

        Every joint has its own random stream, keyed by its name, so that other joints or another
        order in the file do not change its values.
        """
        groups: dict[str, list[str]] = {}
        for joint in sorted(self._joint):
            root = self.root(joint)
            if root is not None:
                groups.setdefault(root, []).append(joint)
        wanted = {
            root: members
            for root, members in groups.items()
            if moved is None or moved.intersection(members)
        }
        streams = {
            root: np.random.default_rng([seed, index, zlib.crc32(root.encode())]) for root in wanted
        }
        values = {root: self._draw_group(streams[root], root, wanted[root]) for root in wanted}
        if not self._loops:
            return values
        for _ in range(_DRAWS):
            qpos = self.configuration(values)
            open_joints = self._close(qpos, frozenset())
            if not open_joints:
                return {root: float(qpos[self._address(root)]) for root in values}
            for root in wanted:
                if open_joints.intersection(wanted[root]):
                    values[root] = self._draw_group(streams[root], root, wanted[root])
        raise spec_error(
            golden,
            place,
            "no random pose closes the model's loops",
            expected="poses given by joint values",
        )

    def _draw_group(self, stream: np.random.Generator, root: str, members: list[str]) -> float:
        """Draw a value of ``root`` that keeps all its followers within their limits."""
        lower, upper = self._range(root)
        qpos = self._model.qpos0.copy()
        value = 0.0
        for _ in range(_DRAWS):
            # Six digits keep a recorded pose readable.
            value = min(max(round(lower + (upper - lower) * stream.random(), 6), lower), upper)
            qpos[self._address(root)] = value
            self._follow(qpos)
            if self._is_within(qpos, members):
                break
        return value

    def roots(self) -> list[str]:
        """Return the joints that follow no other, in model order."""
        return [joint for joint in self._joint if self.root(joint) == joint]

    def span(self, root: str) -> tuple[float, float] | None:
        """Return the range of ``root`` in which it and all its followers are within limits."""
        lower, upper = self._range(root)
        if upper - lower > _ENDLESS:
            # An extremely large limit is no limit.
            reach = math.pi if self.joint_type[root] == "hinge" else 1.0
            lower, upper = max(lower, -reach), min(upper, reach)
        members = [joint for joint in self._joint if self.root(joint) == root]
        if len(members) == 1:
            return lower, upper
        fitting = [
            value
            for value in np.linspace(lower, upper, _GRID).tolist()
            if self._is_within(self.configuration({root: value}), members)
        ]
        return (fitting[0], fitting[-1]) if fitting else None

    def complete(self, values: Mapping[str, float]) -> dict[str, float] | None:
        qpos = self.configuration(values)
        if self._loops and self._close(qpos, frozenset()):
            return None
        chosen = [joint for joint in self._joint if self.root(joint) in values]
        if not self._is_within(qpos, chosen):
            return None
        return {joint: float(qpos[self._address(joint)]) for joint in self._joint}

    def _is_within(self, qpos: FloatArray, joints: Iterable[str]) -> bool:
        for joint in joints:
            low, high = self._range(joint)
            slack = 1e-6 + 1e-3 * (high - low)
            if not low - slack <= qpos[self._address(joint)] <= high + slack:
                return False
        return True

    def _range(self, joint: str) -> tuple[float, float]:
        i = self._joint[joint]
        if self._model.jnt_limited[i]:
            lower, upper = self._model.jnt_range[i]
            return float(lower), float(upper)
        reference = float(self._model.qpos0[self._address(joint)])
        reach = math.pi if self.joint_type[joint] == "hinge" else 1.0
        return reference - reach, reference + reach

    def _address(self, joint: str) -> int:
        return int(self._model.jnt_qposadr[self._joint[joint]])

    def root(self, joint: str) -> str | None:
        """Return the independent joint that ``joint`` follows; None if a constant holds it."""
        seen = {joint}
        while joint in self._masters:
            master = self._masters[joint][0]
            if master is None:
                return None
            if master in seen:
                return min(seen)
            joint = master
            seen.add(joint)
        return joint

    def _follow(self, qpos: FloatArray) -> None:
        """Set the joints that follow others; a chain of n couplings needs n iterations.

        MuJoCo: y - y0 = a0 + a1 (x - x0) + ... + a4 (x - x0)^4, at the reference x0, y0.
        """
        for _ in range(len(self._masters)):
            before = qpos.copy()
            for joint, (master, coefficients) in self._masters.items():
                offset = 0.0
                if master is not None:
                    at = self._address(master)
                    offset = float(qpos[at] - self._model.qpos0[at])
                own = self._address(joint)
                qpos[own] = self._model.qpos0[own] + np.polynomial.polynomial.polyval(
                    offset, coefficients
                )
            if np.array_equal(before, qpos):
                return

    def _close(self, qpos: FloatArray, held: frozenset[str]) -> frozenset[str]:
        """Close kinematic loops in place by Gauss-Newton steps on the joints that are not held.

        Returns:
            Joints of the loops that remain open; empty if all are closed.
        """
        from pytest_twin.realization.equality_rows import EqualityRows

        mujoco, model = self._mujoco, self._model
        rows = EqualityRows(model)
        dofs = np.array(
            [int(model.jnt_dofadr[i]) for name, i in self._joint.items() if name not in held],
            dtype=int,
        )
        dof_joint = {int(model.jnt_dofadr[i]): name for name, i in self._joint.items()}
        residual = np.empty(0)
        jacobian = np.empty((0, model.nv))
        for _ in range(100):
            residual, jacobian = rows.at(qpos)
            if np.all(np.abs(residual) <= _CLOSED):
                return frozenset()
            step = np.zeros(model.nv)
            step[dofs] = np.linalg.lstsq(jacobian[:, dofs], -residual, rcond=1e-9)[0]
            largest = float(np.max(np.abs(step)))
            if largest > 0.5:
                step *= 0.5 / largest
            mujoco.mj_integratePos(model, qpos, step, 1.0)
        still_open = np.abs(residual) > 1e-7
        touched = np.any(np.abs(jacobian[still_open]) > 0.0, axis=0)
        return frozenset(dof_joint[d] for d in np.flatnonzero(touched).tolist() if d in dof_joint)


def encoder_parts(structure: Structure, chain: Iterable[str]) -> frozenset[str]:
    """Return the parts of the encoders of all joints on a chain."""
    placed = frozenset(chain)
    return frozenset(
        f"calibration:{joint}"
        for joint, body in structure.joint_body.items()
        if f"{structure.realization}/kinematics:{body}" in placed
    )
