"""A compiled robot model whose elements are found by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import SpecError
from pytest_twin.metrics.pose import rigid
from pytest_twin.realization import patch
from pytest_twin.realization.source import Source
from pytest_twin.twin import Simulator, Twin

Vector = NDArray[np.float64]
_OBJECTS = {
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
}
_WIDTH_QPOS = {
    mujoco.mjtJoint.mjJNT_FREE: 7,
    mujoco.mjtJoint.mjJNT_BALL: 4,
    mujoco.mjtJoint.mjJNT_SLIDE: 1,
    mujoco.mjtJoint.mjJNT_HINGE: 1,
}
"""MuJoCo's type of a joint -> number of its coordinates."""


class NamedModel:
    """A compiled robot model whose elements are found by name.

    Attributes:
        name: name in ``twin.yaml``.
        twin: the twin that it belongs to, or None.
        path: the MJCF or URDF file.
        source: the checked elements and files from which it was built.
        spec, model: MuJoCo's spec and model, with the twin's fit applied.
        controller, payload: ids of the variant, None for the nominal model.
        simulator: simulator that steps the model.
    """

    # All arguments are keywords, and each is one attribute.
    def __init__(  # noqa: PLR0913
        self,
        *,
        name: str,
        path: Path,
        spec: mujoco.MjSpec,
        model: mujoco.MjModel,
        source: Source,
        twin: Twin | None = None,
        controller: str | None = None,
        payload: str | None = None,
        simulator: Simulator = "mujoco",
    ) -> None:
        self.name = name
        self.path = path
        self.spec = spec
        self.model = model
        self.source = source
        self.twin = twin
        self.controller = controller
        self.payload = payload
        self.simulator: Simulator = simulator

    @property
    def notes(self) -> tuple[str, ...]:
        """Changes and omissions of the conversion, one line each, with file and line."""
        return self.source.notes

    @property
    def velocity_limit(self) -> Mapping[str, float]:
        """Joint -> largest speed, rad/s or m/s, where a URDF states it; MJCF has no such limit."""
        return self.source.velocity_limit

    # -- names

    def _index(self, kind: str, name: str) -> int:
        index = int(mujoco.mj_name2id(self.model, _OBJECTS[kind], name))
        if index < 0:
            raise SpecError(
                f"the model has no {kind} {name!r}",
                path=self.path,
                expected=patch.suggest(name, self.names(kind)),
            )
        return index

    def names(self, kind: str) -> tuple[str, ...]:
        """Names of all elements of a kind, in model order; unnamed elements are left out.

        Args:
            kind: ``joint``, ``actuator``, ``body``, ``site`` or ``geom``.
        """
        count = {
            "joint": self.model.njnt,
            "actuator": self.model.nactuator,
            "body": self.model.nbody,
            "site": self.model.nsite,
            "geom": self.model.ngeom,
        }[kind]
        found = (mujoco.mj_id2name(self.model, _OBJECTS[kind], i) for i in range(count))
        return tuple(name for name in found if name)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of all joints, in model order."""
        return self.names("joint")

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of all actuators, in model order."""
        return self.names("actuator")

    def joint_index(self, joint: str) -> int:
        """Index of a joint in the model's ``jnt_`` arrays."""
        return self._index("joint", joint)

    def joint_qpos_index(self, joint: str) -> int:
        """Index of the joint's (first) value in ``qpos``."""
        return int(self.model.jnt_qposadr[self._index("joint", joint)])

    def joint_dof_index(self, joint: str) -> int:
        """Index of the joint's (first) value in ``qvel`` and in generalized forces."""
        return int(self.model.jnt_dofadr[self._index("joint", joint)])

    def actuator_index(self, actuator: str) -> int:
        """Index of an actuator."""
        return self._index("actuator", actuator)

    def control_index(self, actuator: str) -> int:
        """Index of the actuator's (first) value in ``ctrl``."""
        return int(self.model.actuator_ctrladr[self._index("actuator", actuator)])

    def frame_index(self, frame: str) -> tuple[mujoco.mjtObj, int]:
        """Kind of a frame (site or body) and its index; a site takes precedence over a body."""
        for kind in ("site", "body"):
            index = int(mujoco.mj_name2id(self.model, _OBJECTS[kind], frame))
            if index >= 0:
                return _OBJECTS[kind], index
        known = (*self.names("site"), *self.names("body"))
        raise SpecError(
            f"the model has no frame {frame!r}",
            path=self.path,
            expected=patch.suggest(frame, known),
        )

    # -- configurations

    def qpos(self, joints: Mapping[str, float | Vector]) -> Vector:
        """(nq,) configuration with the given joint values; other joints are at the reference.

        Args:
            joints: joint -> rad or m; (4,) w x y z for a ball joint, (7,) x y z (m), w x y z for
                a free joint.

        Raises:
            SpecError: no such joint, a wrong number of values, or a value that is not finite.
        """
        full: Vector = np.array(self.model.qpos0, dtype=np.float64)
        for joint, value in joints.items():
            index = self._index("joint", joint)
            width = _WIDTH_QPOS[mujoco.mjtJoint(self.model.jnt_type[index])]
            values = np.atleast_1d(np.asarray(value, dtype=np.float64))
            if values.shape != (width,) or not np.isfinite(values).all():
                raise SpecError(
                    f"not a value of joint {joint!r}",
                    path=self.path,
                    value=value,
                    expected="one finite number" if width == 1 else f"{width} finite numbers",
                )
            address = self.model.jnt_qposadr[index]
            full[address : address + width] = values
        return full

    def frame_pose(self, data: mujoco.MjData, frame: str) -> Vector:
        """Pose (4, 4) of a frame in the world, m, for ``data`` after ``mj_kinematics``.

        Its columns are the axes and the origin of the frame in world coordinates.
        """
        kind, index = self.frame_index(frame)
        site = kind == mujoco.mjtObj.mjOBJ_SITE
        return rigid(
            (data.site_xmat if site else data.xmat)[index].reshape(3, 3),
            (data.site_xpos if site else data.xpos)[index],
        )
