"""Helpers for first specs: actuation of a robot, small commands, tolerances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import NothingToProposeError
from pytest_twin.checks.fields import POSITION_UNIT
from pytest_twin.checks.poses import REFERENCE, configuration
from pytest_twin.golden import Golden

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.checks.base import Check
    from pytest_twin.realization import Realization

MOTION_FRACTION = 5e-3
"""Tolerance of a trace as a fraction of its motion. Computations of one model on two machines agree
to about 1e-9; an inertia error of 1 % changes the response to a torque step by twice this
tolerance."""
_LEAST_FRACTION = 1e-4
"""Smallest fraction of the motion that a first spec allows; rounding errors are smaller."""
_NO_ROOM = 1e-5  # rad or m: a joint with a narrower range is held in place
_MASS_CHANGE = 0.05  # a torque step should fail if a link's mass is wrong by this fraction


@dataclass(frozen=True, slots=True)
class Actuation:
    """Actuation of the joints of a robot.

    Attributes:
        held: joints with a position servo, and joints coupled to them.
        loose: all other joints, in model order, including free joints of objects.
        floating: free joints of robots, which carry other joints or are the only joints.
        commands: command modes of the actuators: position, velocity or effort.
    """

    held: frozenset[str]
    loose: tuple[str, ...]
    floating: tuple[str, ...]
    commands: frozenset[str]

    @classmethod
    def of(cls, realization: Realization) -> Actuation:
        """Return the actuation of a realization."""
        from pytest_twin.realization import simulate

        servoed: set[str] = set()
        commands = set()
        for actuator in realization.actuators:
            joints = simulate.driven_joints(realization, actuator)
            command = simulate.command_kind(realization.model, realization.actuator_index(actuator))
            if command == "position":
                servoed.update(joints)
            if joints:
                commands.add(command)
        held = frozenset(
            tied for joint in servoed for tied in simulate.coupled_joints(realization, joint)
        )
        types = realization.structure.joint_type
        floating = tuple(
            joint
            for joint in realization.joints
            if types[joint] == "free" and _carries_robot(realization, joint)
        )
        loose = tuple(j for j in realization.joints if j not in held and j not in floating)
        return cls(held, loose, floating, frozenset(commands))

    def no_controller(self, realization: Realization) -> str | None:
        """Return a note if no servo holds any joint, else None."""
        if self.commands - {"effort"} or not self.loose:
            return None
        if realization.path.suffix.lower() != ".urdf":
            servo = "actuators with a name" if realization.model.nu else "actuators"
            if self.commands:
                servo = "position servos; its motors take torques"
            return f"No controller: the model has no {servo}."
        if not self.commands:
            return (
                "No controller and no motors: a URDF joint gets a motor where its <limit> states "
                "an effort above zero. State efforts there, then servo gains in twin.yaml."
            )
        return (
            "No controller: a URDF states none, and its motors take torques. To test with one, add "
            "servo gains to twin.yaml; the lines are there as comments."
        )


def _carries_robot(realization: Realization, free_joint: str) -> bool:
    structure = realization.structure
    body = structure.joint_body[free_joint]
    others = [b for joint, b in structure.joint_body.items() if joint != free_joint]
    if not others or all(structure.joint_type[j] == "free" for j in structure.joint_body):
        return True
    return any(body in structure.ancestors(other) for other in others)


def fixed_base(realization: Realization) -> str | None:
    """Return a note on a URDF whose base may float: it has mass, and not exactly one limb."""
    if realization.path.suffix.lower() != ".urdf":
        return None
    model = realization.model
    root = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if len(root) != 1 or model.body_jntnum[root[0]] or not model.body_mass[root[0]] > 0.0:
        return None
    if len({_limb(model, int(body)) for body in model.jnt_bodyid}) == 1:
        return None
    return (
        f"{model.body(root[0]).name} is fixed to the world: a URDF does not say whether a base "
        "floats. For one that does, as on legs or rotors, use an MJCF with a <freejoint/>."
    )


def _limb(model: mujoco.MjModel, body: int) -> int:
    """Return the first body with a joint on the chain from the world to ``body``."""
    first = body
    while body:
        if model.body_jntnum[body]:
            first = body
        body = int(model.body_parentid[body])
    return first


def require_mass(realization: Realization) -> None:
    """Check that a joint moves a mass, so that forces and motions mean something.

    Raises:
        NothingToProposeError: no moving link has a mass.
    """
    from pytest_twin.realization.inertia import LEAST_MASS

    model = realization.model
    moved = [float(model.body_subtreemass[body]) for body in model.jnt_bodyid]
    if moved and max(moved) < LEAST_MASS:
        raise NothingToProposeError("no moving link has a mass; state masses in the model first")


def draft(check: Check, realization: Realization, spec: Mapping[str, Any]) -> Golden:
    """Return a first spec as a golden without tolerances, for a trial run."""
    return Golden(
        id=str(spec["name"]),
        path=realization.path,
        kind=check.kind,
        title="",
        realizations=(realization.name,),
        criticality="critical",
        target=spec["target"],
        stimulus=spec["stimulus"],
        tolerance={},
    )


def fraction_of(
    motion: float, unit: str, fraction: float = MOTION_FRACTION, least: float = 1e-9
) -> str:
    """Return a tolerance with unit: a fraction of a motion (SI), rounded down to two digits."""
    value = fraction * motion
    value = max(value, least)
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / step + 1e-9) * step:.2g} {unit}"


def torque_fraction(realization: Realization, joint: str) -> tuple[float, list[str]]:
    """Return the tolerance of a torque step, as a fraction of its motion, and undetected links.

    With the other joints locked, the motion is inversely proportional to the inertia about the
    joint, the sum of the contributions of the carried links. The tolerance is half the change by a
    mass error of 5 % in the link with the smallest contribution, within 0.01 % and 0.5 %.
    """
    import mujoco

    model = realization.model
    data = mujoco.MjData(model)
    data.qpos[:] = first_qpos(realization)
    mujoco.mj_forward(model, data)
    dof = realization.joint_dof_index(joint)
    total = float(model.dof_armature[dof])
    added: dict[str, float] = {}
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for body in range(1, model.nbody):
        if model.body_mass[body] <= 0.0:
            continue
        mujoco.mj_jacBodyCom(model, data, linear, angular, body)
        axes = data.ximat[body].reshape(3, 3)
        spin = axes.T @ angular[:, dof]
        share = float(model.body_mass[body]) * float(linear[:, dof] @ linear[:, dof])
        share += float(spin @ (model.body_inertia[body] * spin))
        if share > 0.0:
            added[str(model.body(body).name)] = share
    total += sum(added.values())
    if not added or not total > 0.0:
        return MOTION_FRACTION, []
    wanted = {link: 0.5 * _MASS_CHANGE * share / total for link, share in added.items()}
    fraction = min(MOTION_FRACTION, max(_LEAST_FRACTION, min(wanted.values())))
    return fraction, [link for link, needed in wanted.items() if needed < fraction]


def drivable(realization: Realization) -> list[tuple[str, str]]:
    """Return (joint, command) for first specs: joints with an input, or all if none has.

    Followers of a coupling and joints with a too narrow range are omitted.
    """
    import mujoco

    from pytest_twin.realization.inputs import joint_inputs

    model = realization.model
    followers = {
        str(model.joint(int(model.eq_obj1id[i])).name)
        for i in range(model.neq)
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT and model.eq_active0[i]
    }
    types = realization.structure.joint_type
    joints = [
        joint
        for joint in realization.joints
        if types.get(joint) in POSITION_UNIT
        and joint not in followers
        and room(realization, joint) > _NO_ROOM
    ]
    found: list[tuple[str, str]] = []
    for joint in joints:
        modes = [item.mode for item in joint_inputs(model, joint)]
        if modes and modes.count(modes[0]) == 1:
            found.append((joint, modes[0]))
    return found or [
        (joint, "effort")
        for joint in joints
        if not any(joint in driven for driven in realization.structure.actuator_joints.values())
    ]


def room(realization: Realization, joint: str) -> float:
    """Return the width of a hinge or slide joint's range, rad or m; infinite without a range."""
    model, index = realization.model, realization.joint_index(joint)
    if not model.jnt_limited[index]:
        return math.inf
    return float(model.jnt_range[index, 1] - model.jnt_range[index, 0])


def tendon_drives(realization: Realization) -> list[tuple[str, str]]:
    """Return (actuator, first joint) of actuators that drive joints through a tendon."""
    import mujoco

    from pytest_twin.realization import simulate

    model, types = realization.model, realization.structure.joint_type
    found = []
    for actuator in realization.actuators:
        index = realization.actuator_index(actuator)
        if model.actuator_trntype[index] != mujoco.mjtTrn.mjTRN_TENDON:
            continue
        joints = [j for j in simulate.driven_joints(realization, actuator) if j]
        scalar = [joint for joint in joints if types.get(joint) in POSITION_UNIT]
        if scalar:
            found.append((actuator, scalar[0]))
    return found


def tendon_amplitude(realization: Realization, actuator: str) -> float | None:
    """Return a tenth of an actuator's control range, signed to the farther limit, or None."""
    import mujoco

    from pytest_twin.realization import simulate

    model = realization.model
    control = realization.control_index(actuator)
    if not model.actuator_ctrllimited[control]:
        return None
    data = simulate.initial_state(model, realization, first_qpos(realization))
    hold = float(simulate.hold(model, data)[control])
    mujoco.mj_forward(model, data)
    lower, upper = (float(bound) for bound in model.actuator_ctrlrange[control])
    sign = 1.0 if upper - hold >= hold - lower else -1.0
    return float(f"{sign * 0.1 * (upper - lower):.3g}")


def first_bench(realization: Realization, command: str) -> dict[str, Any]:
    """Return pose and surroundings of a first spec.

    Other joints are locked if no servo holds them. Contact is off if bodies overlap at the pose."""
    from pytest_twin.realization import simulate

    alone = command != "position" or "free" in realization.structure.joint_type.values()
    bench: dict[str, Any] = {"pose": simulate.first_pose(realization), "gravity": not alone}
    if alone:
        bench["others"] = "locked"
    if simulate.overlaps(realization, first_qpos(realization)):
        bench["contact"] = False
    return bench


def first_amplitude(realization: Realization, joint: str, command: str, duration: float) -> float:
    """Return a small command step to the farther limit, in the command's unit, three digits.

    Position: 5 % of the range, at most 0.1 rad or 0.02 m. Velocity: the speed that travels this
    distance in ``duration`` s. Effort: the effort that accelerates over this distance in
    ``duration`` s, plus dry friction.
    """
    import mujoco

    from pytest_twin.realization.inputs import command_input

    model = realization.model
    index = realization.joint_index(joint)
    travel = 0.1 if realization.structure.joint_type[joint] == "hinge" else 0.02
    data = mujoco.MjData(model)
    data.qpos[:] = first_qpos(realization)
    mujoco.mj_forward(model, data)
    sign = 1.0
    if model.jnt_limited[index]:
        lower, upper = (float(bound) for bound in model.jnt_range[index])
        travel = min(travel, 0.05 * (upper - lower))
        sign = 1.0 if data.qpos[model.jnt_qposadr[index]] <= 0.5 * (lower + upper) else -1.0
    amplitude = travel
    if command == "velocity":
        amplitude = travel / duration
    elif command == "effort":
        dof = int(model.jnt_dofadr[index])
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        amplitude = 2.0 * travel / duration**2 * float(inertia[dof, dof])
        amplitude += 1.5 * float(model.dof_frictionloss[dof])
    item = command_input(model, joint, command)  # type: ignore[arg-type]
    if item is not None and model.actuator_ctrllimited[item.control]:
        bounds = model.actuator_ctrlrange[item.control] / item.scale
        amplitude = min(amplitude, 0.1 * float(abs(bounds[1] - bounds[0])))
    return float(f"{sign * amplitude:.3g}")


def first_qpos(realization: Realization) -> FloatArray:
    """Return (nq,) coordinates of the initial pose of first specs."""
    from pytest_twin.realization import simulate

    pose = simulate.first_pose(realization)
    if isinstance(pose, str):
        model = realization.model
        return np.array(model.qpos0 if pose == REFERENCE else model.key(pose).qpos)
    return configuration(realization, pose["joints"])


def first_pose(realization: Realization) -> str | dict[str, dict[str, float]]:
    """Return the initial pose of first specs, in the form of a spec."""
    from pytest_twin.realization import simulate

    return simulate.first_pose(realization)
