"""Describe a URDF as read by Pinocchio."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from pytest_twin.asset.loss import shapes
from pytest_twin.asset.loss.description import Description, JointFacts
from pytest_twin.asset.loss.shapes import Shape
from pytest_twin.errors import ModelError
from pytest_twin.realization.reference_urdf import dynamics_text
from pytest_twin.realization.urdf import Robot

Vector = NDArray[np.float64]


class PinocchioDynamics:
    """Kinematics and dynamics of a Pinocchio model, indexed by names of the URDF."""

    def __init__(self, model: pin.Model, root: str) -> None:
        self.model = model
        self._data = model.createData()
        self._ids = {
            name: model.getJointId(name)
            for name in model.names
            if name != "universe" and model.joints[model.getJointId(name)].nv == 1
        }
        self._frames = {
            frame.name: index
            for index, frame in enumerate(model.frames)
            if frame.type == pin.FrameType.BODY
        }
        self._frames.setdefault(root, 0)

    @property
    def joints(self) -> tuple[str, ...]:
        """Return joints with one degree of freedom, in Pinocchio's order."""
        return tuple(self._ids)

    @property
    def frames(self) -> tuple[str, ...]:
        """Return the links."""
        return tuple(self._frames)

    def _configuration(self, q: Mapping[str, float]) -> Vector:
        full: Vector = pin.neutral(self.model)
        for name, value in q.items():
            joint = self.model.joints[self._ids[name]]
            wide = joint.nq == 2
            full[joint.idx_q : joint.idx_q + joint.nq] = (
                [np.cos(value), np.sin(value)] if wide else [value]
            )
        return full

    def poses(self, q: Mapping[str, float]) -> dict[str, Vector]:
        """Return ``transform_root_to_frame`` (4, 4) of every link."""
        pin.framesForwardKinematics(self.model, self._data, self._configuration(q))
        return {name: self._data.oMf[i].homogeneous for name, i in self._frames.items()}

    def mass(self) -> float:
        """Return the total mass, static links included, kg."""
        return float(sum(inertia.mass for inertia in self.model.inertias))

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """Return the (3,) centre of mass, static links included, m."""
        pin.forwardKinematics(self.model, self._data, self._configuration(q))
        moment = np.zeros(3)
        for placement, inertia in zip(self._data.oMi, self.model.inertias, strict=True):
            moment += inertia.mass * placement.act(inertia.lever)
        mass = self.mass()
        return moment / mass if mass > 0 else moment

    def _columns(self) -> list[int]:
        return [self.model.joints[i].idx_v for i in self._ids.values()]

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """Return (n,) efforts that hold the joints against gravity, N*m or N."""
        torque = pin.computeGeneralizedGravity(self.model, self._data, self._configuration(q))
        return np.asarray(torque[self._columns()])

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """Return the (n, n) mass matrix."""
        matrix = np.array(pin.crba(self.model, self._data, self._configuration(q)))
        matrix = np.triu(matrix) + np.triu(matrix, 1).T
        columns = self._columns()
        return np.asarray(matrix[np.ix_(columns, columns)])


def reference(robot: Robot) -> PinocchioDynamics:
    """Load the rigid bodies of a URDF, without shapes, in Pinocchio.

    Raises:
        ModelError: Pinocchio refuses the URDF.
    """
    try:
        return PinocchioDynamics(pin.buildModelFromXML(dynamics_text(robot.node)), robot.root)
    except (ValueError, RuntimeError, IndexError) as error:
        words = " ".join(str(error).split())
        raise ModelError(f"Pinocchio refuses it: {words}", path=robot.node.path) from None


def describe(path: Path, robot: Robot) -> Description:
    """Describe the normalized URDF as loaded by ``pinocchio.buildModelFromUrdf``.

    Raises:
        ModelError: Pinocchio refuses the URDF.
    """
    try:
        model = pin.buildModelFromUrdf(str(path))
        geometry = pin.buildGeomFromUrdf(
            model, str(path), pin.GeometryType.COLLISION, None, [str(path.parent)]
        )
    except (ValueError, RuntimeError, IndexError) as error:
        words = " ".join(str(error).split())
        raise ModelError(f"Pinocchio refuses it: {words}", path=path) from None
    kinds = {1: "hinge", 3: "planar", 6: "free"}
    joints = {}
    for name in list(model.names)[1:]:
        joint = model.joints[model.getJointId(name)]
        sliding = joint.shortname().startswith("JointModelP") and joint.nv == 1
        kind = "slide" if sliding else kinds[joint.nv]
        joints[name] = _joint(model, joint, kind)
    found: dict[str, list[Shape]] = {}
    for shape in geometry.geometryObjects:
        frame = model.frames[shape.parentFrame]
        found.setdefault(frame.name, []).append(_shape(shape, frame.placement))
    return Description(
        name="Pinocchio",
        engine=f"Pinocchio {pin.__version__}",
        dynamics=PinocchioDynamics(model, robot.root),
        links={},
        joints=joints,
        independent=int(model.nv),
        actuators={},
        shapes={link: shapes.in_order(held) for link, held in found.items()},
    )


def _joint(model: pin.Model, joint: pin.JointModel, kind: str) -> JointFacts:
    if joint.nv != 1:
        return JointFacts(kind)
    v, q = joint.idx_v, joint.idx_q
    bounds = None
    if joint.nq == 1:
        lower, upper = float(model.lowerPositionLimit[q]), float(model.upperPositionLimit[q])
        if max(abs(lower), abs(upper)) < 1e30:
            bounds = (lower, upper)
    return JointFacts(
        kind,
        bounds,
        _bound(model.velocityLimit[v]),
        _bound(model.effortLimit[v]),
        float(model.damping[v]),
        float(model.friction[v]),
        0.0,
    )


def _bound(value: float) -> float | None:
    return float(value) if abs(value) < 1e30 else None


def _shape(shape: pin.GeometryObject, link: pin.SE3) -> Shape:
    geometry = shape.geometry
    # Both placements are relative to the joint's frame.
    pose = (link.inverse() * shape.placement).homogeneous
    if isinstance(geometry, coal.Box):
        return shapes.of_box(2 * np.asarray(geometry.halfSide), pose)
    if isinstance(geometry, coal.Sphere):
        return shapes.of_sphere(geometry.radius, pose)
    if isinstance(geometry, coal.Cylinder):
        return shapes.of_round("cylinder", geometry.radius, 2 * geometry.halfLength, pose)
    if isinstance(geometry, coal.Capsule):
        return shapes.of_round("capsule", geometry.radius, 2 * geometry.halfLength, pose)
    convex = isinstance(geometry, coal.ConvexBase)
    points = np.array(geometry.points() if convex else geometry.vertices()).reshape(-1, 3)
    return shapes.of_points("convex hull" if convex else "mesh", points, pose)
