"""Direction of motion of each joint for a displacement and a command, compared with the spec."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import POSITION_UNIT, known_name, quantity, spec_error, tolerance
from pytest_twin.checks.poses import POSE_SCHEMA, REFERENCE, Pose, keyframe_parts, resolve_pose
from pytest_twin.checks.proposals import require_mass
from pytest_twin.checks.schemas import array, choice, mapping, number, table, text
from pytest_twin.dependency import Structure
from pytest_twin.errors import SimulationError
from pytest_twin.golden import Golden
from pytest_twin.metrics.pose import direction_error, rotation_vector

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization import Realization


WORLD = "world"
_DISPLACEMENT = {"hinge": 0.02, "slide": 0.002}  # rad, m
_STILL = 1e-9  # rad or m: the direction of a smaller motion is undefined
_PULSE = 0.1  # s
_STEPS = 20_000  # bound on the steps of a pulse
_LARGEST = 0.1  # rad or m: largest motion by a pulse
_SHRINKS = 9
"""Number of amplitudes of a pulse that are tried, each a tenth of the one before."""


class JointDirection(Check):
    """Direction in which a named frame moves when one joint's value increases.

    The displacement is symmetric about the pose, so that a frame on an arc moves along its
    tangent. The command is a short, small pulse on one actuator, without gravity, contact, stops
    and dry friction. The joint's motion is the difference to a simulation without the pulse.

    ``values``: ``direction`` joint -> (3,) unit vector in the declared frame, ``command`` joint
    -> motion by the pulse, rad or m.
    """

    kind: ClassVar[str] = "joint_direction"
    tolerances: ClassVar[Mapping[str, str]] = {"direction": "rad"}
    required_tolerances: ClassVar[frozenset[str]] = frozenset({"direction"})
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "joints": mapping(
                    table(
                        {
                            "frame": text("Body or site whose motion is measured.", minLength=1),
                            "rotation": array(
                                number(), "Axis of the frame's right-handed rotation.", count=3
                            ),
                            "translation": array(
                                number(), "Direction of motion of the frame's origin.", count=3
                            ),
                            "in": text(
                                "Frame, at the pose of the stimulus, in which the vector is "
                                "expressed. Default: 'world'.",
                                minLength=1,
                            ),
                            "actuator": text(
                                "Actuator whose command is increased in simulation.", minLength=1
                            ),
                            "command": choice(
                                ["positive", "negative"],
                                "Direction in which an increasing command moves the joint. "
                                "Default: positive.",
                            ),
                        },
                        required=["frame"],
                        oneOf=[{"required": ["rotation"]}, {"required": ["translation"]}],
                    ),
                    "Joint -> how a frame moves when the position of the joint increases.",
                    minProperties=1,
                )
            },
            required=["joints"],
        ),
        "stimulus": table(
            {
                "pose": POSE_SCHEMA,
                "duration": text("Time for which the command is applied. Default: '100 ms'."),
            }
        ),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Ids of the kinematics of the frames, and of the dynamics of joints with an actuator."""
        joints = golden.target["joints"]
        frames = {
            frame
            for entry in joints.values()
            for frame in (entry["frame"], entry.get("in", WORLD))
            if frame != WORLD
        }
        commanded = [joint for joint, entry in joints.items() if "actuator" in entry]
        parts = {
            *structure.chain(frames),
            *keyframe_parts(golden, structure),
        }
        return parts | (structure.dynamics(commanded) if commanded else frozenset())

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Displace each joint, then command it."""
        structure = realization.structure
        kinds = {j: kind for j, kind in structure.joint_type.items() if kind in POSITION_UNIT}
        pose = resolve_pose(
            golden, realization, golden.stimulus.get("pose", REFERENCE), "stimulus.pose"
        )
        duration = quantity(
            golden, "stimulus.duration", golden.stimulus.get("duration", _PULSE), "s"
        )
        directions: dict[str, list[float]] = {}
        commands: dict[str, float] = {}
        joints = golden.target["joints"]
        for joint_index, (joint, entry) in enumerate(joints.items()):
            place = f"target.joints.{joint}"
            known_name(golden, place, joint, kinds, "hinge or slide joint")
            known_name(golden, f"{place}.frame", entry["frame"], structure.frame_body, "frame")
            base = entry.get("in", WORLD)
            known_name(golden, f"{place}.in", base, {WORLD, *structure.frame_body}, "frame")
            directions[joint] = _motion_direction(realization, joint, entry, pose).tolist()
            if "actuator" in entry:
                actuator = known_name(
                    golden,
                    f"{place}.actuator",
                    entry["actuator"],
                    realization.actuators,
                    "actuator",
                )
                if joint not in structure.actuator_joints.get(actuator, ()):
                    raise spec_error(
                        golden,
                        f"{place}.actuator",
                        f"this actuator does not drive joint {joint!r}",
                        value=actuator,
                        expected=_drivers(structure, joint),
                    )
                commands[joint] = pulse(realization, joint, actuator, pose.qpos, duration)
            progress((joint_index + 1) / len(joints))
        return Observation({"direction": directions, "command": commands})

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare measured and declared direction; a wrong command direction counts as pi rad."""
        bound = tolerance(golden, "direction", "every joint_direction golden bounds it")
        measures = []
        for joint, entry in golden.target["joints"].items():
            motion = "rotation" if "rotation" in entry else "translation"
            error = direction_error(observation.values["direction"][joint], entry[motion])
            measures.append(
                Measure.of_error(
                    "direction", f"{joint}: {motion} of {entry['frame']}", error, bound, "declared"
                )
            )
            if joint in observation.values["command"]:
                added = observation.values["command"][joint]
                sign = -1.0 if entry.get("command") == "negative" else 1.0
                turned = float("nan") if not abs(added) > _STILL else 0.0
                turned += np.pi if sign * added < 0.0 else 0.0
                subject = f"{joint}: command of {entry['actuator']}"
                measures.append(Measure.of_error("direction", subject, turned, bound, "declared"))
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose every hinge and slide joint, with the body that it moves in the model."""
        require_mass(realization)
        structure = realization.structure
        pose = Pose(REFERENCE, {}, None, realization.model.qpos0.copy())
        named_bodies = set(realization.names("body"))
        joints: dict[str, Any] = {}
        for joint in realization.joints:
            kind = structure.joint_type.get(joint)
            if kind not in POSITION_UNIT or structure.joint_body[joint] not in named_bodies:
                continue
            motion = "rotation" if kind == "hinge" else "translation"
            entry: dict[str, Any] = {"frame": structure.joint_body[joint], motion: [0.0, 0.0, 0.0]}
            direction = _motion_direction(realization, joint, entry, pose)
            if not np.isfinite(direction).all():
                continue
            entry[motion] = [round(float(value), 6) + 0.0 for value in direction]
            for actuator in realization.actuators:
                if structure.actuator_joints.get(actuator) == (joint,):
                    added = pulse(realization, joint, actuator, pose.qpos, _PULSE)
                    if abs(added) > _STILL:
                        entry["actuator"] = actuator
                        entry["command"] = "positive" if added > 0.0 else "negative"
                        break
            joints[joint] = entry
        if not joints:
            raise NothingToProposeError("no hinge or slide joint with a name moves a named body")
        return [
            {
                "name": "joint_direction",
                "title": "Every joint moves its body the declared way",
                "target": {"joints": joints},
                "stimulus": {"pose": REFERENCE},
                "tolerance": {"direction": "0.1 deg"},
            }
        ]


def _drivers(structure: Structure, joint: str) -> str:
    drivers = [name for name, driven in structure.actuator_joints.items() if joint in driven]
    return " or ".join(repr(name) for name in drivers) or "no actuator: nothing drives this joint"


def _motion_direction(
    realization: Realization, joint: str, entry: Mapping[str, Any], pose: Pose
) -> FloatArray:
    """Return the (3,) unit direction in the declared frame; NaN if the frame does not move."""
    import mujoco

    model = realization.model
    data = mujoco.MjData(model)
    transforms = []
    half = 0.5 * _DISPLACEMENT[realization.structure.joint_type[joint]]
    for step in (0.0, half, -half):
        data.qpos[:] = pose.qpos
        data.qpos[realization.joint_qpos_index(joint)] += step
        mujoco.mj_kinematics(model, data)
        if step == 0.0:
            base = entry.get("in", WORLD)
            rotation = np.eye(3) if base == WORLD else realization.frame_pose(data, base)[:3, :3]
        else:
            transforms.append(realization.frame_pose(data, entry["frame"]))
    after, before = transforms
    if "rotation" in entry:
        motion = rotation_vector(after[:3, :3] @ before[:3, :3].T)
    else:
        motion = after[:3, 3] - before[:3, 3]
    length = float(np.linalg.norm(motion))
    if not length > _STILL:
        return np.full(3, np.nan)
    return np.asarray(rotation.T @ motion / length, dtype=np.float64)


def pulse(
    realization: Realization, joint: str, actuator: str, qpos: FloatArray, duration: float
) -> float:
    """Return the change of a joint's position by an increased command, rad or m.

    It is the difference of two simulations from rest at ``qpos``, without gravity, contact, stops
    and dry friction: one with the command of smallest actuator force, one with a larger command.
    The increase starts at 5 % of the command's range and shrinks until the motion is small.

    Raises:
        SimulationError: the simulation diverges for every command.
    """
    import mujoco

    from pytest_twin.realization import simulate

    model = simulate.prepare_model(realization, gravity=False)
    disable = mujoco.mjtDisableBit
    model.opt.disableflags |= int(
        disable.mjDSBL_CONTACT | disable.mjDSBL_LIMIT | disable.mjDSBL_FRICTIONLOSS
    )
    control = realization.control_index(actuator)
    address = realization.joint_qpos_index(joint)
    steps = min(simulate.steps_in(model, duration), _STEPS)
    hold = simulate.hold(model, simulate.initial_state(model, realization, qpos))

    def end(command: float) -> FloatArray:
        data = simulate.initial_state(model, realization, qpos)
        data.ctrl[:] = simulate.hold(model, data)
        data.ctrl[control] = command
        for _ in range(steps):
            mujoco.mj_step(model, data)
            simulate.check_finite(model, data)
        return np.array(data.qpos)

    rest, step = _command(model, control, float(hold[control]))
    start = end(rest)
    for _ in range(_SHRINKS):
        try:
            moved = end(rest + step) - start
        except SimulationError:
            moved = np.full(model.nq, np.inf)
        if np.max(np.abs(moved)) <= _LARGEST:
            break
        step *= 0.1
    return float(moved[address])


def _command(model: mujoco.MjModel, control: int, rest: float) -> tuple[float, float]:
    """Command near that of rest, and an increase that stays within the actuator's range."""
    if not model.actuator_ctrllimited[control]:
        return rest, max(0.05, 0.05 * abs(rest))
    lower, upper = (float(bound) for bound in model.actuator_ctrlrange[control])
    step = 0.05 * (upper - lower)
    return min(max(rest, lower), upper - step), step
