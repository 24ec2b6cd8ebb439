"""Serial kinematic chain from a robot's base to a frame, from URDF, MJCF or ``twin.yaml``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pytest_twin.errors import ModelError
from pytest_twin.formats import xml
from pytest_twin.realization import reference_mjcf, reference_urdf, urdf
from pytest_twin.realization.loading import load
from pytest_twin.realization.patch import suggest
from pytest_twin.realization.rigid_model import RigidModel
from pytest_twin.twin import JointCalibration, load_twin

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class SerialChain:
    """Serial kinematic chain from the base to a frame.

    Attributes:
        base: name of the first frame.
        frame: name of the last frame.
        joints: (n,) names, from the base on.
        placements: (n, 4, 4) pose of each joint's frame in the previous one, at joint value 0, m.
        axes: (n, 3) unit axis of each joint in its frame.
        revolute: (n,) True for a hinge, False for a slide.
        end: (4, 4) pose of the last frame in the frame of the last joint, m.
        signs, offsets: (n,) ``model = sign * reading + offset``, from ``twin.yaml``, rad or m;
            ``signs`` includes the scale of the encoder.
        limits: (n, 2) lower and upper limit of the model's position, rad or m, infinite where the
            joint is unlimited; None where they are unknown.
    """

    base: str
    frame: str
    joints: tuple[str, ...]
    placements: Vector
    axes: Vector
    revolute: NDArray[np.bool_]
    end: Vector
    signs: Vector
    offsets: Vector
    limits: Vector | None = None

    def frames(self, values: Vector) -> tuple[Vector, Vector]:
        """Places of the joints and of the last frame, and axes of the joints, in the base.

        Args:
            values: (rows, n) joint values of the model, rad or m.

        Returns:
            (rows, n + 1, 3) places, m, and (rows, n, 3) unit axes.
        """
        pose = np.tile(np.eye(4), (len(values), 1, 1))
        places, axes = [], []
        for at, axis in enumerate(self.axes):
            pose = pose @ self.placements[at]
            places.append(pose[:, :3, 3])
            axes.append(pose[:, :3, :3] @ axis)
            moved = np.tile(np.eye(4), (len(values), 1, 1))
            if self.revolute[at]:
                turns = Rotation.from_rotvec(values[:, at, None] * axis)
                moved[:, :3, :3] = turns.as_matrix()
            else:
                moved[:, :3, 3] = values[:, at, None] * axis
            pose = pose @ moved
        places.append((pose @ self.end)[:, :3, 3])
        return np.stack(places, axis=1), np.stack(axes, axis=1)


def load_serial_chain(path: Path, frame: str) -> SerialChain:
    """Load the kinematic chain from the base to ``frame``; meshes of a URDF are not read.

    Args:
        path: URDF, MJCF or ``twin.yaml``.
        frame: link of a URDF, site or body of an MJCF.

    Raises:
        TwinError: the model cannot be read, has no such frame, or has a joint with more than one
            degree of freedom in the chain.
    """
    calibration: dict[str, JointCalibration] = {}
    twin = None
    if path.suffix.lower() in (".yaml", ".yml"):
        twin = load_twin(path)
        path = twin.first_realization.file
        if twin.calibration is not None:
            calibration = dict(twin.calibration.joints)
    if xml.parse(path).tag == "robot":
        robot = urdf.read(path)
        base, rigid = robot.root, _of_urdf(robot, path)
        limits = {name: joint.limits for name, joint in robot.joints.items() if joint.limits}
    else:
        # Loaded without the twin: its calibrated base pose is an unknown of the calibration.
        realization = load(path)
        base, rigid = "world", reference_mjcf.build(realization)
        limits = _ranges(realization.model)
    if frame not in rigid.frames:
        raise ModelError(
            f"the model has no frame {frame!r}",
            path=path,
            where="flange",
            expected=suggest(frame, tuple(rigid.frames)),
        )
    chain = _series(rigid, base, frame, calibration, path)
    free = (-np.inf, np.inf)
    return replace(chain, limits=np.array([limits.get(name, free) for name in chain.joints]))


def _ranges(model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    return {
        model.joint(at).name: (float(model.jnt_range[at, 0]), float(model.jnt_range[at, 1]))
        for at in range(model.njnt)
        if model.jnt_limited[at]
    }


def _of_urdf(robot: urdf.Robot, path: Path) -> RigidModel:
    try:
        model = pin.buildModelFromXML(reference_urdf.dynamics_text(robot.node))
    except (ValueError, RuntimeError, IndexError) as error:
        raise ModelError(
            f"Pinocchio refuses the model: {' '.join(str(error).split())}", path=path
        ) from None
    rigid = RigidModel(model=model)
    for link in robot.links:
        found = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
        rigid.frames[link] = (found.parentJoint, found.placement)
    rigid.joints = {name: i for i, name in enumerate(model.names) if i > 0}
    return rigid


def _series(
    rigid: RigidModel,
    base: str,
    frame: str,
    calibration: dict[str, JointCalibration],
    path: Path,
) -> SerialChain:
    model = rigid.model
    last, end = rigid.frames[frame]
    names = {at: name for name, at in rigid.joints.items()}
    placements, axes, revolute, joints = [], [], [], []
    for at in list(model.supports[last])[1:]:
        joint = model.joints[at]
        name = names.get(at, model.names[at])
        if joint.nv != 1:
            raise ModelError(
                f"joint {name!r} has {joint.nv} degrees of freedom",
                path=path,
                expected="joints of one degree of freedom between the base and the flange",
            )
        data = joint.createData()
        joint.calc(data, pin.neutral(model))
        subspace = np.asarray(data.S, dtype=np.float64).ravel()
        turns = bool(np.linalg.norm(subspace[3:]) > 0.5)
        placement = model.jointPlacements[at].homogeneous
        reference = rigid.reference.get(name, 0.0)
        if reference:
            placement = placement @ _joint_motion(subspace, -reference)
        placements.append(placement)
        axes.append(subspace[3:] if turns else subspace[:3])
        revolute.append(turns)
        joints.append(name)
    known = [calibration.get(name, JointCalibration()) for name in joints]
    return SerialChain(
        base=base,
        frame=frame,
        joints=tuple(joints),
        placements=np.reshape(placements, (-1, 4, 4)),
        axes=np.reshape(axes, (-1, 3)),
        revolute=np.array(revolute, dtype=bool),
        end=np.array(end.homogeneous),
        signs=np.array([one.slope for one in known], dtype=np.float64),
        offsets=np.array([one.offset for one in known], dtype=np.float64),
    )


def _joint_motion(subspace: Vector, value: float) -> Vector:
    moved: Vector = pin.exp6(pin.Motion(subspace * value)).homogeneous
    return moved
