"""A common interface to realizations for property tests, and its implementations.

Simulators are imported only when a test runs, so that the collection of tests is fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pytest_twin.asset.loss.description import Description, Dynamics, JointFacts, LinkFacts
from pytest_twin.properties.trees import joint_names

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

Vector = NDArray[np.float64]
ALL = frozenset({"links", "shapes", "range", "velocity", "effort", "damping", "friction", "mimic"})
EARTH = (0.0, 0.0, -9.81)
"""Gravity, m/s^2."""


@dataclass(frozen=True, eq=False)
class Form:
    """A realization for property tests.

    Attributes:
        name: name in error messages.
        description: its links, joints, shapes and dynamics.
        carries: quantities that this kind of file can express; others are not compared.
        complete: whether it must contain all frames and joints of the first realization.
        single: whether its numbers have single precision.
        gravity: (3,) m/s^2 in its root frame.
        model: MuJoCo's model, or None.
        rotors: joint -> armature in its mass matrix, kg*m^2 or kg.
    """

    name: str
    description: Description
    carries: frozenset[str]
    complete: bool = True
    single: bool = False
    gravity: tuple[float, float, float] = EARTH
    model: Any = None
    rotors: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def dynamics(self) -> Dynamics:
        """Dynamics of the realization; values of joints that it lacks are ignored."""
        return _DynamicsOfKnownJoints(self.description.dynamics)


class _DynamicsOfKnownJoints:
    """Dynamics that ignore the values of unknown joints."""

    def __init__(self, dynamics: Dynamics) -> None:
        self._dynamics = dynamics
        self.joints = dynamics.joints
        self.frames = dynamics.frames
        self.mass = dynamics.mass
        self._known = frozenset(dynamics.joints)

    def _own(self, q: Mapping[str, float]) -> dict[str, float]:
        return {joint: value for joint, value in q.items() if joint in self._known}

    def poses(self, q: Mapping[str, float]) -> Mapping[str, Vector]:
        return self._dynamics.poses(self._own(q))

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        return self._dynamics.center_of_mass(self._own(q))

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        return self._dynamics.gravity_torque(self._own(q))

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        return self._dynamics.mass_matrix(self._own(q))


def text_form(urdf: Path) -> Form:
    """Realization of a URDF from its own values, without a physics engine."""
    from pytest_twin.realization import urdf as urdf_text
    from pytest_twin.realization import urdf_tree

    robot = urdf_text.read(urdf)
    tree = urdf_tree.build(robot)
    kinds = {**urdf_tree.SCALAR, "floating": "free", "planar": "planar"}
    moving = [joint for joint in robot.in_order() if joint.type != "fixed"]
    facts = {
        joint.name: JointFacts(
            kinds[joint.type],
            joint.limits,
            joint.velocity,
            joint.effort,
            joint.damping,
            joint.friction,
        )
        for joint in moving
    }
    mimics = {
        joint.name: (joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
        for joint in moving
        if joint.mimic is not None
    }
    links = {
        link.name: LinkFacts(link.mass, link.com, link.inertia) for link in robot.links.values()
    }
    found = Description(
        "URDF", "its own text", tree, links, facts, len(facts) - len(mimics), {}, mimics=mimics
    )
    return Form("URDF", found, ALL - {"shapes"})


def mujoco_form(urdf: Path) -> Form:
    """Realization of a normalized URDF in MuJoCo; writes an MJCF with full precision next to it."""
    from pytest_twin.asset.loss import from_mujoco
    from pytest_twin.formats.paths import Roots
    from pytest_twin.realization import mjcf_file, urdf_spec
    from pytest_twin.realization import urdf as urdf_text
    from pytest_twin.realization.files.packages import Packages
    from pytest_twin.realization.files.urdf import UrdfFiles

    robot = urdf_text.read(urdf)
    converted = urdf_spec.convert(robot, UrdfFiles(Roots(urdf.parent), Packages()))
    model = mjcf_file.write(converted.spec, urdf.with_suffix(".xml"), converted.mesh_paths)
    return Form(
        "MuJoCo",
        from_mujoco.describe(model, robot.root),
        ALL - {"velocity"},
        model=model,
    )


def pinocchio_form(urdf: Path) -> Form:
    """Realization of a normalized URDF in Pinocchio."""
    from pytest_twin.asset.loss import from_pinocchio
    from pytest_twin.realization import urdf as urdf_text

    found = from_pinocchio.describe(urdf, urdf_text.read(urdf))
    return Form("Pinocchio", found, ALL - {"links", "mimic"})


def usd_form(urdf: Path) -> Form:
    """Realization of a normalized URDF in UsdPhysics; the stage is written next to it.

    Raises:
        UsdMissingError: the extra ``usd`` is not installed.
    """
    from pytest_twin.realization import usd

    stage = urdf.with_suffix(".usdc")
    usd.convert(urdf, stage)
    return stage_form(stage)


def stage_form(stage: Path) -> Form:
    """Realization of a USD stage in UsdPhysics."""
    from pytest_twin.asset.loss import from_usd

    return Form("USD", from_usd.describe(stage), ALL - {"effort"}, single=True)


def realization_form(realization: Realization, name: str, *, complete: bool) -> Form:
    """Realization of a twin in MuJoCo, with fit and base pose applied."""
    from pytest_twin.asset.loss import from_mujoco

    gravity = tuple(float(value) for value in realization.model.opt.gravity)
    return Form(
        name,
        from_mujoco.describe(realization.model, "world"),
        (ALL - {"velocity"}) | ({"armature"} if realization.source.kind == "mjcf" else set()),
        complete=complete,
        gravity=gravity,  # type: ignore[arg-type]
        model=realization.model,
        rotors=_rotors(realization),
    )


def reference_form(realization: Realization, name: str, *, complete: bool) -> Form:
    """Realization of the same source in Pinocchio, with the fit applied."""
    dynamics = ReferenceDynamics(realization)
    found = Description("Pinocchio", "Pinocchio", dynamics, {}, _kinds(realization), 0, {})
    gravity = tuple(float(value) for value in realization.model.opt.gravity)
    return Form(
        name,
        found,
        frozenset(),
        complete=complete,
        gravity=gravity,  # type: ignore[arg-type]
        rotors=_rotors(realization),
    )


class ReferenceDynamics:
    """Dynamics of a realization's Pinocchio reference."""

    def __init__(self, realization: Realization) -> None:
        self._reference = realization.reference
        facts = _kinds(realization)
        widths = {"ball": 3, "free": 6}
        self._columns: list[int] = []
        self._joints: list[str] = []
        at = 0
        for name in self._reference.joints:
            kind = facts[name].kind
            if kind in ("hinge", "slide"):
                self._joints.append(name)
                self._columns.append(at)
            at += widths.get(kind, 1)
        self._frames = realization.names("body")

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of hinges and slides."""
        return tuple(self._joints)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the bodies."""
        return self._frames

    def poses(self, q: Mapping[str, float]) -> dict[str, Vector]:
        """Pose (4, 4) of each body in the world, m."""
        return {frame: self._reference.frame_pose(q, frame) for frame in self._frames}

    def mass(self) -> float:
        """Total mass, kg."""
        return self._reference.mass()

    def center_of_mass(self, q: Mapping[str, float]) -> Vector:
        """(3,) centre of mass in the world, m."""
        return self._reference.center_of_mass(q)

    def gravity_torque(self, q: Mapping[str, float]) -> Vector:
        """(n,) generalized forces that balance gravity, N*m or N."""
        torque = self._reference.gravity_torque(q)
        return np.array([float(torque[name]) for name in self._joints])

    def mass_matrix(self, q: Mapping[str, float]) -> Vector:
        """(n, n) mass matrix with armature, SI units."""
        return self._reference.mass_matrix(q)[np.ix_(self._columns, self._columns)]


def _rotors(realization: Realization) -> dict[str, float]:
    model = realization.model
    return {
        joint: float(model.dof_armature[realization.joint_dof_index(joint)])
        for joint in realization.joints
    }


def _kinds(realization: Realization) -> dict[str, JointFacts]:
    import mujoco

    kinds = {
        int(mujoco.mjtJoint.mjJNT_HINGE): "hinge",
        int(mujoco.mjtJoint.mjJNT_SLIDE): "slide",
        int(mujoco.mjtJoint.mjJNT_BALL): "ball",
        int(mujoco.mjtJoint.mjJNT_FREE): "free",
    }
    model = realization.model
    return {
        name: JointFacts(kinds[int(kind)])
        for name, kind in zip(joint_names(model), model.jnt_type, strict=True)
    }
