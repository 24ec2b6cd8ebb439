"""Helpers that serialize ros2_control messages with the library ``rosbags``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
DYNAMIC = "control_msgs/msg/DynamicJointState"
ARRAY = "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOINT_STATE = "sensor_msgs/msg/JointState"

_POINT = "trajectory_msgs/JointTrajectoryPoint"
_MULTI = "trajectory_msgs/MultiDOFJointTrajectoryPoint"
_OLD = (
    f"std_msgs/Header header\nstring[] joint_names\n{_POINT} desired\n{_POINT} actual\n"
    f"{_POINT} error\n"
)
_NEW = (
    f"std_msgs/Header header\nstring[] joint_names\n{_POINT} reference\n{_POINT} feedback\n"
    f"{_POINT} error\n{_POINT} output\nstring[] multi_dof_joint_names\n"
    f"{_MULTI} multi_dof_reference\n{_MULTI} multi_dof_feedback\n{_MULTI} multi_dof_error\n"
    f"{_MULTI} multi_dof_output\nfloat64 speed_scaling_factor\n"
)
_INTERFACE = "string[] interface_names\nfloat64[] values\n"
_DYNAMIC = (
    "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values\n"
)


def _store(controller_state: str) -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = get_types_from_msg(controller_state, CONTROLLER_STATE)
    types |= get_types_from_msg(_INTERFACE, "control_msgs/msg/InterfaceValue")
    types |= get_types_from_msg(_DYNAMIC, DYNAMIC)
    store.register(types)
    return store


OLD, NEW = _store(_OLD), _store(_NEW)


def _type(name: str, store: Any = NEW) -> Any:
    return store.types[name]


def header(stamp: int) -> Any:
    sec, nanosec = divmod(stamp, 1_000_000_000)
    time = _type("builtin_interfaces/msg/Time")(sec, nanosec)
    return _type("std_msgs/msg/Header")(time, "base")


def point(
    positions: Sequence[float] = (),
    velocities: Sequence[float] = (),
    effort: Sequence[float] = (),
    after: int = 0,
    accelerations: Sequence[float] = (),
) -> Any:
    sec, nanosec = divmod(after, 1_000_000_000)
    return _type("trajectory_msgs/msg/JointTrajectoryPoint")(
        np.array(positions, float),
        np.array(velocities, float),
        np.array(accelerations, float),
        np.array(effort, float),
        _type("builtin_interfaces/msg/Duration")(sec, nanosec),
    )


def controller_state(
    stamp: int, names: Sequence[str], setpoint: Any, measured: Any, *, old: bool
) -> bytes:
    store = OLD if old else NEW
    kind = _type(CONTROLLER_STATE, store)
    if old:
        message = kind(header(stamp), list(names), setpoint, measured, point())
    else:
        duration = _type("builtin_interfaces/msg/Duration")(0, 0)
        multi = _type("trajectory_msgs/msg/MultiDOFJointTrajectoryPoint")([], [], [], duration)
        message = kind(
            header(stamp), list(names), setpoint, measured, point(), point(), [], multi, multi,
            multi, multi, 1.0,
        )  # fmt: skip
    return bytes(store.serialize_cdr(message, CONTROLLER_STATE))


def dynamic(stamp: int, joints: dict[str, dict[str, float]]) -> bytes:
    interface = _type("control_msgs/msg/InterfaceValue")
    values = [interface(list(v), np.array(list(v.values()), float)) for v in joints.values()]
    message = _type(DYNAMIC)(header(stamp), list(joints), values)
    return bytes(NEW.serialize_cdr(message, DYNAMIC))


def array(values: Sequence[float], labels: Sequence[str] = ()) -> bytes:
    dimension = _type("std_msgs/msg/MultiArrayDimension")
    layout = _type("std_msgs/msg/MultiArrayLayout")([dimension(x, 1, 1) for x in labels], 0)
    return bytes(NEW.serialize_cdr(_type(ARRAY)(layout, np.array(values, float)), ARRAY))


def trajectory(stamp: int, names: Sequence[str], points: Sequence[Any]) -> bytes:
    message = _type(TRAJECTORY)(header(stamp), list(names), list(points))
    return bytes(NEW.serialize_cdr(message, TRAJECTORY))


ROS_1 = get_typestore(Stores.ROS1_NOETIC)


def ros1_joint_state(stamp: int, names: Sequence[str], positions: Sequence[float]) -> bytes:
    store = ROS_1
    sec, nanosec = divmod(stamp, 1_000_000_000)
    time = store.types["builtin_interfaces/msg/Time"](sec, nanosec)
    head = store.types["std_msgs/msg/Header"](7, time, "base")
    empty = np.array([], float)
    message = store.types[JOINT_STATE](head, list(names), np.array(positions, float), empty, empty)
    return bytes(store.serialize_ros1(message, JOINT_STATE))


def joint_state(stamp: int, names: Sequence[str], positions: Sequence[float]) -> bytes:
    empty = np.array([], float)
    message = _type(JOINT_STATE)(
        header(stamp), list(names), np.array(positions, float), empty, empty
    )
    return bytes(NEW.serialize_cdr(message, JOINT_STATE))


GOAL = "control_msgs/msg/FollowJointTrajectoryActionGoal"
_TOLERANCE = "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
_FOLLOW = (
    "trajectory_msgs/JointTrajectory trajectory\ncontrol_msgs/JointTolerance[] path_tolerance\n"
    "control_msgs/JointTolerance[] goal_tolerance\nduration goal_time_tolerance\n"
)
_ACTION_GOAL = (
    "std_msgs/Header header\nactionlib_msgs/GoalID goal_id\n"
    "control_msgs/FollowJointTrajectoryGoal goal\n"
)


def ros1_trajectory(
    stamp: int, names: Sequence[str], points: Sequence[Any], *, in_goal: bool, encoding: str
) -> bytes:
    """A ``JointTrajectory`` of ROS 1, whose header has a number, or the goal of its action.

    Args:
        encoding: ``ros1``, or ``cdr`` as ``rosbags-convert`` writes it, without the number.
    """
    old = encoding == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    follow = _FOLLOW if old else _FOLLOW.replace("duration", "builtin_interfaces/Duration")
    types = get_types_from_msg(_TOLERANCE, "control_msgs/msg/JointTolerance")
    types |= get_types_from_msg(follow, "control_msgs/msg/FollowJointTrajectoryGoal")
    types |= get_types_from_msg(_ACTION_GOAL, GOAL)
    store.register(types)

    def make(name: str, *fields: Any) -> Any:
        return store.types[name](*fields)

    def head(stamp: int) -> Any:
        time = make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
        return make("std_msgs/msg/Header", *([7] if old else []), time, "base")

    message, kind = make(TRAJECTORY, head(stamp), list(names), list(points)), TRAJECTORY
    if in_goal:
        tolerance = make("control_msgs/msg/JointTolerance", "a", 0.1, 0.2, 0.3)
        late = make("builtin_interfaces/msg/Duration", 1, 0)
        goal = make(
            "control_msgs/msg/FollowJointTrajectoryGoal",
            message,
            [tolerance, tolerance],
            [tolerance],
            late,
        )
        identity = make(
            "actionlib_msgs/msg/GoalID", make("builtin_interfaces/msg/Time", 1, 2), "/move-1"
        )
        message, kind = make(GOAL, head(5_000_000_006), identity, goal), GOAL
    return bytes((store.serialize_ros1 if old else store.serialize_cdr)(message, kind))


def as_json(**fields: Any) -> bytes:
    return json.dumps(fields).encode()
