"""A USD stage stepped by Newton (extra ``newton``): Featherstone's solver, on the CPU.

Newton reads bodies, joints and couplings from the stage. Masses, damping, armature, ranges and
drives are set to those of the realization's MJCF (:mod:`pytest_twin.realization.usd_model`), which
has the twin's fit, controller and payload in it. Numbers have single precision. Newton's
``SolverMuJoCo`` is not used: it needs MuJoCo 3.
"""

from __future__ import annotations

import copy
import importlib
import importlib.util
import math
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pytest_twin.errors import ModelError, SpecError, TwinError
from pytest_twin.metrics.pose import rigid, rotation_of
from pytest_twin.realization.inertia import compiled_inertia
from pytest_twin.realization.model import Realization
from pytest_twin.realization.simulate import SimulatedMotion, divergence_error
from pytest_twin.realization.usd_names import display_name, link_prims

Vector = NDArray[np.float64]
INSTALL = "pip install 'pytest-twin[newton]'"
_DAMPING_STEP, _STIFFNESS_STEP = 0.5, 0.1
"""Explicit integration is stable while a step times damping over inertia is below 2, and a step
times the natural frequency (rad/s) below 2. The first leaves a factor of 4; under the second the
frequency that semi-implicit Euler shows is 0.04 % off (Hairer et al. 2006, I.1.4)."""
_MOST_SUBSTEPS = 200
"""Largest number of substeps of a time step, which limits the computing time."""
_PLAIN_BIASES = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
_FASTEST = 1e6
"""rad/s or m/s; beyond it a simulation has diverged."""


class NewtonMissingError(TwinError):
    """The extra ``newton`` is not installed."""


def require(path: Path) -> None:
    """Check that Newton is installed.

    Raises:
        NewtonMissingError: it is not.
    """
    if importlib.util.find_spec("newton") is None:
        raise NewtonMissingError(
            "the extra 'newton' is not installed, and MuJoCo does not step USD",
            path=path,
            expected=INSTALL,
        )


def _newton() -> Any:
    """Import Newton; Warp prints only warnings, not every kernel that it compiles."""
    warp = importlib.import_module("warp")
    warp.config.log_level = warp.LOG_WARNING
    return importlib.import_module("newton")


def omitted_forces(realization: Realization) -> tuple[str, ...]:
    """Return the forces of a model that Newton does not simulate.

    Returns:
        One line for each kind of force at joints that the model has and Newton's solver lacks.

    Raises:
        ModelError: an actuator other than a motor or a servo of one joint.
    """
    model = realization.model
    for actuator in range(model.nactuator):
        is_supported = (
            model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
            and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
            and model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
            and int(model.actuator_biastype[actuator]) in _PLAIN_BIASES
        )
        if not is_supported:
            raise ModelError(
                f"Newton has no actuator like {model.actuator(actuator).name!r}",
                path=realization.path,
                expected="motors, position servos and velocity servos of single joints",
            )
    omitted = {
        "dry friction": model.dof_frictionloss != 0.0,
        "force limits of joints": model.jnt_actfrclimited != 0,
        "force limits of actuators": model.actuator_forcelimited != 0,
    }
    return tuple(
        f"{realization.path}: Newton's Featherstone solver has no {name}; the model states them "
        f"for {int(np.count_nonzero(stated))} of {len(stated)}"
        for name, stated in omitted.items()
        if np.any(stated)
    )


def forward_kinematics(
    realization: Realization,
) -> Callable[[Vector, Iterable[str]], dict[str, Vector]]:
    """Forward kinematics of Newton, as :func:`pytest_twin.realization.simulate.forward_kinematics`.

    The frames are links.
    """
    newton = _newton()
    stage = _stage(realization)
    model = stage.builder.finalize(device="cpu")
    state = model.state()

    def poses(qpos: Vector, frames: Iterable[str]) -> dict[str, Vector]:
        state.joint_q.assign(stage.by_dof(qpos))
        newton.eval_fk(model, state.joint_q, state.joint_qd, state)
        bodies = state.body_q.numpy().astype(np.float64)
        return {frame: stage.pose(frame, bodies) for frame in frames}

    return poses


def simulate(
    realization: Realization,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    steps: int,
    progress: Callable[[float], None] | None = None,
) -> SimulatedMotion:
    """Step the stage on from the state of ``data`` under its controls and applied forces.

    Args:
        realization: the realization whose path is the stage.
        model: its :func:`pytest_twin.realization.simulate.prepare_model`, with contacts disabled.
        data: initial state, controls and applied forces; contains the last state afterwards.
        steps: number of steps of the model's timestep; stiff drives are simulated with substeps.
        progress: called with the fraction done.

    Returns:
        As :func:`pytest_twin.realization.simulate.simulate`. Energy and work are MuJoCo's for
        Newton's states: work that neither drives nor applied forces do is ``constraint_work``.
        ``penetration`` is zero.

    Raises:
        SpecError: contacts are on.
        SimulationError: it diverged, or a drive is too stiff.
    """
    newton = _newton()
    if not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        raise SpecError(
            "a realization on Newton is stepped without contacts",
            path=realization.path,
            where="stimulus.contact",
            value="true",
            expected="contact: false",
        )
    stage = _stage(realization)
    timestep = float(model.opt.timestep)
    drives = _Drives(realization, model, data)
    substeps = drives.substeps(timestep)
    made = stage.with_parameters(model, drives)
    solver = newton.solvers.SolverFeatherstone(made, angular_damping=0.0)
    control = made.control()
    control.joint_target_q.assign(stage.by_dof(drives.target))
    control.joint_f.assign(stage.by_dof(drives.effort))
    state, following = made.state(), made.state()
    state.joint_q.assign(stage.by_dof(data.qpos))
    state.joint_qd.assign(stage.by_dof(data.qvel))
    newton.eval_fk(made, state.joint_q, state.joint_qd, state)

    time: Vector = float(data.time) + timestep * np.arange(steps + 1, dtype=np.float64)
    qpos, qvel = np.empty((steps + 1, model.nq)), np.empty((steps + 1, model.nv))
    for k in range(steps + 1):
        qpos[k] = stage.values(state.joint_q)
        qvel[k] = stage.values(state.joint_qd)
        if not np.isfinite(qvel[k]).all() or np.abs(qvel[k]).max() > _FASTEST:
            speed = np.where(np.isfinite(qvel[k]), np.abs(qvel[k]), np.inf)
            raise divergence_error(model, int(np.argmax(speed)), float(time[k]))
        for _ in range(substeps if k < steps else 0):
            state.clear_forces()
            solver.step(state, following, control, None, timestep / substeps)
            state, following = following, state
        if progress is not None and k % 256 == 0:
            progress(k / steps)
    data.time, data.qpos[:], data.qvel[:] = time[-1], qpos[-1], qvel[-1]
    energy, actuator_work, constraint_work = _energies(model, data, qpos, qvel)
    return SimulatedMotion(
        time, qpos, qvel, energy, actuator_work, constraint_work, np.zeros(steps + 1), None
    )


def _energies(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: Vector, qvel: Vector
) -> tuple[Vector, Vector, Vector]:
    """(n + 1,) J each: energy, and work since the start by actuators and by constraints."""
    free = copy.copy(model)
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    probe = mujoco.MjData(free)
    probe.ctrl[:], probe.qfrc_applied[:] = data.ctrl, data.qfrc_applied
    timestep = float(model.opt.timestep)
    energy, actuator, constraint = (np.zeros(len(qpos)) for _ in range(3))
    for k, (position, velocity) in enumerate(zip(qpos, qvel, strict=True)):
        probe.qpos[:], probe.qvel[:] = position, velocity
        mujoco.mj_forward(free, probe)
        energy[k] = probe.energy[0] + probe.energy[1]
        if k + 1 == len(qpos):
            break
        applied = probe.qfrc_actuator + probe.qfrc_applied
        probe.qacc[:] = (qvel[k + 1] - velocity) / timestep
        mujoco.mj_inverse(free, probe)
        motion = 0.5 * timestep * (velocity + qvel[k + 1])
        actuator[k + 1] = actuator[k] + applied @ motion
        constraint[k + 1] = constraint[k] + (probe.qfrc_inverse - applied) @ motion
    return energy, actuator, constraint


class _Drives:
    """Actuators in Newton's form: ``stiffness * (target - q) - damping * v + effort``.

    Attributes:
        stiffness, damping, target, effort: (nv,) values by degree of freedom of the model: N*m/rad
            or N/m, N*m*s/rad or N*s/m, rad or m, N*m or N.
    """

    def __init__(
        self, realization: Realization, model: mujoco.MjModel, data: mujoco.MjData
    ) -> None:
        self.model = model
        self.where = realization.path
        self.stiffness, self.damping = np.zeros(model.nv), np.zeros(model.nv)
        self.target = np.zeros(model.nv)
        self.effort: Vector = np.array(data.qfrc_applied)
        for actuator in range(model.nactuator):
            dof = int(model.jnt_dofadr[model.actuator_trnid[actuator, 0]])
            gear = float(model.actuator_gear[actuator, 0])
            control = float(data.ctrl[model.actuator_ctrladr[actuator]])
            constant, per_length, per_velocity = (
                float(value) for value in model.actuator_biasprm[actuator, :3]
            )
            self.stiffness[dof] -= gear**2 * per_length
            self.damping[dof] -= gear**2 * per_velocity
            self.effort[dof] += gear * (
                float(model.actuator_gainprm[actuator, 0]) * control + constant
            )
        held = self.stiffness > 0.0
        self.target[held] = self.effort[held] / self.stiffness[held]
        self.effort[held] = 0.0

    def substeps(self, timestep: float) -> int:
        """Return the number of substeps with which explicit integration is stable.

        Args:
            timestep: timestep of the model, s.

        Raises:
            ModelError: a drive needs more than ``_MOST_SUBSTEPS``.
        """
        inertia = self.model.dof_M0
        needed = max(
            float(np.max((self.damping + self.model.dof_damping) / inertia)) / _DAMPING_STEP,
            float(np.max(np.sqrt(self.stiffness / inertia))) / _STIFFNESS_STEP,
        )
        substeps = max(1, math.ceil(timestep * needed - 1e-6))
        if substeps > _MOST_SUBSTEPS:
            raise ModelError(
                "a drive is too stiff for Newton's explicit solver",
                path=self.where,
                value=f"{substeps} steps in one of {timestep:g} s",
                expected=f"at most {_MOST_SUBSTEPS}; a shorter timestep of the stage, or armature",
            )
        return substeps


class _Stage:
    """A stage in Newton, with the indices of joints and links.

    Attributes:
        builder: Newton's model builder, after reading the stage.
        bodies: link -> index of its body in Newton.
        fixed: link without a body -> its parent (None: the world) and (4, 4) pose in the parent.
    """

    def __init__(self, path: Path, joints: tuple[str, ...]) -> None:
        from pxr import Usd

        from pytest_twin.realization.usd_read import read

        newton = _newton()
        self.builder: Any = newton.ModelBuilder()
        found = self.builder.add_usd(str(path), load_visual_shapes=False)
        # A stage need not mark a robot of one joint as articulated, and the solver moves no others.
        alone = [i for i, of in enumerate(self.builder.joint_articulation) if of < 0]
        if alone:
            self.builder.add_articulation(alone)
        stage = Usd.Stage.Open(str(path))
        prims = {str(prim.GetPath()): prim for prim in stage.Traverse()}
        body_of = found["path_body_map"]
        self.bodies: Mapping[str, int] = {
            name: body_of[str(prim.GetPath())]
            for name, prim in link_prims(stage).items()
            if str(prim.GetPath()) in body_of
        }
        self.fixed: Mapping[str, tuple[str | None, Vector]] = {
            body.name: (body.parent, body.placement)
            for body in read(path).tree.bodies.values()
            if body.name not in self.bodies
        }
        if newton.JointType.FREE in self.builder.joint_type:
            raise ModelError(
                "a stage whose base floats",
                path=path,
                expected="a base that a fixed joint holds to the world",
            )
        joint_of = {
            display_name(prims[place]): index for place, index in found["path_joint_map"].items()
        }
        for name in joints:
            if name not in joint_of:
                raise ModelError(
                    f"Newton reads no joint {name!r} from the stage",
                    path=path,
                    expected="a PhysicsJoint prim of that name",
                )
        starts = self.builder.joint_qd_start
        self._dofs = [int(starts[joint_of[name]]) for name in joints]

    def by_dof(self, values: Vector) -> NDArray[np.float32]:
        """Convert (n,) values of the model's joints to Newton's order; each joint has one."""
        found = np.zeros(self.builder.joint_dof_count, dtype=np.float32)
        found[self._dofs] = values
        return found

    def pose(self, frame: str, bodies: Vector) -> Vector:
        """``transform_world_to_frame`` (4, 4) of a link, from the (n, 7) poses of all bodies."""
        offset = np.eye(4)
        link: str | None = frame
        while link is not None and link not in self.bodies:
            link, placement = self.fixed.get(link, (None, np.eye(4)))
            offset = placement @ offset
        return offset if link is None else _matrix(bodies[self.bodies[link]]) @ offset

    def values(self, array: Any) -> Vector:
        """Convert Newton's joint array to the model's order, (n,)."""
        values: Vector = array.numpy()[self._dofs].astype(np.float64)
        return values

    def with_parameters(self, model: mujoco.MjModel, drives: _Drives) -> Any:
        """Return Newton's model with the masses, joints, drives and gravity of ``model``."""
        made = self.builder.finalize(device="cpu")
        made.joint_armature.assign(self.by_dof(model.dof_armature))
        made.joint_damping.assign(self.by_dof(model.dof_damping))
        made.joint_target_ke.assign(self.by_dof(drives.stiffness))
        made.joint_target_kd.assign(self.by_dof(drives.damping))
        limited = np.asarray(model.jnt_limited, dtype=bool)
        lower, upper = model.jnt_range.T
        made.joint_limit_lower.assign(self.by_dof(np.where(limited, lower, -np.inf)))
        made.joint_limit_upper.assign(self.by_dof(np.where(limited, upper, np.inf)))
        masses, centers, tensors = (
            getattr(made, name).numpy().copy() for name in ("body_mass", "body_com", "body_inertia")
        )
        for name, body in self.bodies.items():
            at = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            masses[body], centers[body], tensors[body] = compiled_inertia(model, at)
        made.body_mass.assign(masses)
        made.body_com.assign(centers)
        made.body_inertia.assign(tensors)
        heavy = masses > 0.0
        made.body_inv_mass.assign(np.where(heavy, 1.0 / np.where(heavy, masses, 1.0), 0.0))
        tensors[~heavy] = np.eye(3)
        made.body_inv_inertia.assign(np.linalg.inv(tensors).astype(np.float32))
        weight = model.opt.gravity
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
            weight = np.zeros(3)
        made.set_gravity(tuple(float(value) for value in weight))
        return made


def _stage(realization: Realization) -> _Stage:
    modified = realization.path.stat().st_mtime_ns
    return _read_stage(realization.path, modified, realization.joints)


@lru_cache(maxsize=4)
def _read_stage(path: Path, modified_ns: int, joints: tuple[str, ...]) -> _Stage:
    return _Stage(path, joints)


def _matrix(transform: Vector) -> Vector:
    """Return the (4, 4) matrix of Newton's transform: x y z [m], qx qy qz qw."""
    return rigid(rotation_of(np.roll(transform[3:], 1)), transform[:3])
