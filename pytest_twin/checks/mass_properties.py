"""Mass, centre of mass and gravity torque, compared with the record and Pinocchio."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import known_name, spec_error, tolerance
from pytest_twin.checks.poses import (
    POSES_SCHEMA,
    REFERENCE,
    keyframe_parts,
    recorded_poses,
    resolve_poses,
)
from pytest_twin.checks.proposals import require_mass
from pytest_twin.checks.schemas import array, table, text
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.metrics.pose import position_error

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_NAN = float("nan")
_GRAVITY = {"hinge": "gravity_torque", "slide": "gravity_force"}


class MassProperties(Check):
    """Mass, centre of mass and gravity torques of the robot.

    The gravity torque of a joint is the generalized force that keeps it still at the pose: N*m
    for a hinge, N for a slide, positive along the joint's axis.

    ``values``: ``mass`` in kg, ``poses`` (drawn poses), ``center_of_mass`` pose -> (3,) m in
    the world, ``gravity`` pose -> joint -> N*m or N, ``bodies`` body -> mass in kg and centre of
    mass (3,) m in the body frame.
    """

    kind: ClassVar[str] = "mass_properties"
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "pin")
    tolerances: ClassVar[Mapping[str, str]] = {
        "mass": "kg",
        "center_of_mass": "m",
        "gravity_torque": "N*m",
        "gravity_force": "N",
    }
    required_tolerances: ClassVar[frozenset[str]] = frozenset({"mass", "center_of_mass"})
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "joints": array(
                    text(minLength=1),
                    "Joints whose gravity torque is compared. Default: all.",
                    uniqueItems=True,
                ),
                "bodies": array(
                    text(minLength=1),
                    "Bodies whose mass and centre of mass are compared. Default: none.",
                    uniqueItems=True,
                ),
            }
        ),
        "stimulus": table({"poses": POSES_SCHEMA}, required=["poses"]),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return inertia and placement of all bodies, couplings of joints, and gravity."""
        name = structure.realization
        layers = tuple(f"{name}/{layer}:" for layer in ("inertia", "kinematics", "coupling"))
        return {
            *(part for part in structure.part_ids if part.startswith(layers)),
            f"{name}/option:gravity",
            *keyframe_parts(golden, structure),
        }

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute mass properties at every pose with MuJoCo and Pinocchio."""
        import mujoco

        model = realization.model
        structure = realization.structure
        scalar = [
            joint for joint in realization.joints if structure.joint_type.get(joint) in _GRAVITY
        ]
        joints = [
            known_name(golden, f"target.joints.{i}", joint, scalar, "hinge or slide joint")
            for i, joint in enumerate(golden.target.get("joints", scalar))
        ]
        bodies = [
            known_name(golden, f"target.bodies.{i}", body, structure.body_parent, "body")
            for i, body in enumerate(golden.target.get("bodies", []))
        ]
        _require_stated_masses(golden, realization, bodies)
        poses = resolve_poses(golden, realization)
        reference = realization.reference
        data = mujoco.MjData(model)
        force = np.zeros(model.nv)
        center: dict[str, list[float]] = {}
        gravity: dict[str, dict[str, float]] = {}
        reference_center: dict[str, list[float]] = {}
        reference_gravity: dict[str, dict[str, float]] = {}
        for number, pose in enumerate(poses):
            data.qpos[:] = pose.qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, force)
            center[pose.name] = data.subtree_com[0].tolist()
            gravity[pose.name] = {
                joint: float(force[realization.joint_dof_index(joint)]) for joint in joints
            }
            reference_center[pose.name] = np.asarray(reference.center_of_mass(pose.joints)).tolist()
            torque = reference.gravity_torque(pose.joints)
            reference_gravity[pose.name] = {
                joint: float(torque.get(joint, _NAN)) for joint in joints
            }
            progress((number + 1) / len(poses))
        own = {
            body: {
                "mass": float(model.body(body).mass[0]),
                "center_of_mass": model.body(body).ipos.tolist(),
            }
            for body in bodies
        }
        return Observation(
            {
                "mass": float(np.sum(model.body_mass)),
                "poses": recorded_poses(poses),
                "center_of_mass": center,
                "gravity": gravity,
                "bodies": own,
                "joint_type": {joint: structure.joint_type[joint] for joint in joints},
            },
            reference={
                "mass": float(reference.mass()),
                "center_of_mass": reference_center,
                "gravity": reference_gravity,
            },
        )

    def expect(
        self, golden: Golden, observation: Observation
    ) -> tuple[Mapping[str, Any], Trace | None]:
        """Return all values except joint types, which belong to the model."""
        return {k: v for k, v in observation.values.items() if k != "joint_type"}, None

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare total mass, centre of mass and torques at their worst poses, and each body."""
        found = observation.values
        sources = [("pinocchio", observation.reference)]
        if golden.expected is not None:
            sources.insert(0, ("golden", golden.expected))
        measures: list[Measure] = []
        for against, expected in sources:
            measures.append(
                self._scalar(golden, "mass", "robot", found["mass"], expected.get("mass"), against)
            )
            measures.append(self._center(golden, found, expected, against))
            measures.extend(self._gravity(golden, found, expected, against))
        if golden.expected is not None:
            recorded = golden.expected.get("bodies", {})
            for body, own in found["bodies"].items():
                was = recorded.get(body, {})
                measures.append(
                    self._scalar(golden, "mass", body, own["mass"], was.get("mass"), "golden")
                )
                measures.append(
                    self._offset(
                        golden,
                        f"{body}, in its frame",
                        _distance(own["center_of_mass"], was.get("center_of_mass")),
                        "golden",
                    )
                )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose the whole robot at reference, keyframes and ten random poses."""
        import mujoco

        model = realization.model
        if float(np.sum(model.body_mass)) <= 0.0:
            raise NothingToProposeError("the model has no mass")
        require_mass(realization)
        keyframes = [name for i in range(model.nkey) if (name := model.key(i).name)]
        bounds = {"mass": "1e-6 kg", "center_of_mass": "1 um"}
        types = {int(kind) for kind in model.jnt_type}
        if int(mujoco.mjtJoint.mjJNT_HINGE) in types:
            bounds["gravity_torque"] = "1e-6 N*m"
        if int(mujoco.mjtJoint.mjJNT_SLIDE) in types:
            bounds["gravity_force"] = "1e-6 N"
        return [
            {
                "name": "mass_properties",
                "title": "Mass, centre of mass and gravity torque of the whole robot",
                "target": {},
                "stimulus": {"poses": [REFERENCE, *keyframes, {"seed": 1, "count": 10}]},
                "tolerance": bounds,
            }
        ]

    def _scalar(
        self,
        golden: Golden,
        name: str,
        subject: str,
        measured: float,
        expected: float | None,
        against: str,
    ) -> Measure:
        value = _NAN if expected is None else float(expected)
        bound = tolerance(golden, name, f"the {name.replace('_', ' ')} of {subject}")
        return Measure.of_difference(name, subject, (measured, value), bound, against)

    def _offset(self, golden: Golden, subject: str, error: float, against: str) -> Measure:
        bound = tolerance(golden, "center_of_mass", "every golden of this kind bounds it")
        return Measure.of_error("center_of_mass", subject, error, bound, against)

    def _center(
        self, golden: Golden, found: Mapping[str, Any], expected: Mapping[str, Any], against: str
    ) -> Measure:
        was = expected.get("center_of_mass", {})
        errors = {
            pose: _distance(center, was.get(pose))
            for pose, center in found["center_of_mass"].items()
        }
        pose = max(errors, key=lambda key: _nan_first(errors[key]))
        return self._offset(golden, f"robot at {pose}", errors[pose], against)

    def _gravity(
        self, golden: Golden, found: Mapping[str, Any], expected: Mapping[str, Any], against: str
    ) -> list[Measure]:
        measures = []
        was = expected.get("gravity", {})
        for joint, kind in found["joint_type"].items():
            candidates = [
                self._scalar(
                    golden,
                    _GRAVITY[kind],
                    f"{joint} at {pose}",
                    torques[joint],
                    was.get(pose, {}).get(joint),
                    against,
                )
                for pose, torques in found["gravity"].items()
            ]
            measures.append(max(candidates, key=lambda measure: _nan_first(measure.error)))
        return measures


def _require_stated_masses(golden: Golden, realization: Realization, bodies: list[str]) -> None:
    """Check that the compared masses are the robot's, and not made up so that it can be simulated.

    Raises:
        SpecError: the robot or a compared body has no mass.
    """
    from pytest_twin.realization.inertia import LEAST_MASS, MASS_FLOOR

    model = realization.model
    expected = "masses in the model's file, or in a fit of twin.yaml"
    total = float(np.sum(model.body_mass))
    if total < LEAST_MASS:
        raise spec_error(
            golden, "target", "the robot has no mass", value=total, unit="kg", expected=expected
        )
    for i, body in enumerate(bodies):
        mass = float(model.body(body).mass[0])
        if 0.0 < mass <= MASS_FLOOR:
            raise spec_error(
                golden, f"target.bodies.{i}", f"{body} has no mass",
                value=mass, unit="kg", expected=expected,
            )  # fmt: skip


def _distance(found: list[float], expected: list[float] | None) -> float:
    return _NAN if expected is None else position_error(found, expected)


def _nan_first(error: float) -> float:
    return float("inf") if np.isnan(error) else error
