"""Decoders of the ROS message types that carry joint states or commands.

Each type is decoded from CDR, from the ROS 1 serialization and from JSON with the same field names.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pytest_twin.formats import foxglove, joint_state
from pytest_twin.formats.json_fields import names_of, object_of, stamp_of, values_of
from pytest_twin.formats.ros_serialization import (
    QUANTITIES,
    Batch,
    Cursor,
    Decoded,
    Encoding,
    Integers,
    Layout,
    MessageError,
    check_names,
    decode,
)
from pytest_twin.formats.trajectory import POINT_FIELDS, decode_trajectories, trajectory_from_json


class MessageType(Protocol):
    """Decoder of one message type for one role (``state`` or ``command``)."""

    def serialized(
        self, data: bytes, starts: Integers, sizes: Integers, encoding: Encoding
    ) -> Iterator[Decoded]:
        """Decode many messages; see :func:`pytest_twin.formats.ros_serialization.decode`."""
        ...

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message.

        Raises:
            MessageError: the message is not JSON, or lacks these fields.
        """
        ...


class JointState:
    """``sensor_msgs/msg/JointState``."""

    def serialized(
        self, data: bytes, starts: Integers, sizes: Integers, encoding: Encoding
    ) -> Iterator[Decoded]:
        """Decode many messages."""
        return decode(data, starts, sizes, joint_state.layout_of, encoding)

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message."""
        return joint_state.decode_json(message, row)


class _OneLayout(ABC):
    """A type whose messages state names and values in one layout."""

    def serialized(
        self, data: bytes, starts: Integers, sizes: Integers, encoding: Encoding
    ) -> Iterator[Decoded]:
        """Decode many messages."""
        return decode(data, starts, sizes, self._layout, encoding)

    @abstractmethod
    def _layout(self, cursor: Cursor) -> Layout:
        """Return the byte positions of the fields of one message."""


@dataclass(frozen=True)
class ControllerState(_OneLayout):
    """``control_msgs/msg/JointTrajectoryControllerState``: ``reference`` or ``feedback``.

    The setpoint is the first point and the measurement the second, both in the layout of ROS 2
    Iron and later and in the older one (``desired`` and ``actual``). Later fields are not read.

    Attributes:
        role: ``command`` reads the setpoint, ``state`` the measurement.
    """

    role: str

    def _layout(self, cursor: Cursor) -> Layout:
        stamp_at = cursor.header()
        names = cursor.names()
        points = []
        for field in ("reference", "feedback"):
            position = cursor.doubles(f"{field}.positions")
            velocity = cursor.doubles(f"{field}.velocities")
            cursor.doubles(f"{field}.accelerations")
            effort = cursor.doubles(f"{field}.effort")
            cursor.skip(8, f"{field}.time_from_start")
            points.append({"position": position, "velocity": velocity, "effort": effort})
        return cursor.layout(names, stamp_at, points[self.role == "state"])

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message."""
        found = object_of(message)
        names = names_of(found.get("joint_names"), "joint_names")
        newer, older = ("feedback", "actual") if self.role == "state" else ("reference", "desired")
        point = found.get(newer, found.get(older))
        if not isinstance(point, dict):
            raise MessageError(f"{newer} is not an object")
        stamp, bad = stamp_of(found.get("header"))
        values = {
            quantity: values_of(point.get(field), f"{newer}.{field}", len(names))
            for quantity, field in POINT_FIELDS.items()
        }
        return Batch(np.array([row]), tuple(names), np.array([stamp]), bad, values)


class DynamicJointState(_OneLayout):
    """``control_msgs/msg/DynamicJointState``: named interfaces of each joint."""

    def _layout(self, cursor: Cursor) -> Layout:
        stamp_at = cursor.header()
        names = cursor.names()
        if cursor.count("interface_values") != len(names):
            raise MessageError("interface_values and joint_names differ in length")
        at = {quantity: [-1] * len(names) for quantity in QUANTITIES}
        for joint in range(len(names)):
            interfaces = cursor.names("an interface's name")
            values = cursor.doubles("interface_values.values")
            if len(values) != len(interfaces):
                raise MessageError(f"{len(values)} values for {len(interfaces)} interfaces")
            for interface, place in zip(interfaces, values, strict=True):
                if interface in at:
                    at[interface][joint] = place
        cursor.end()
        found = {q: tuple(places) for q, places in at.items() if max(places, default=-1) >= 0}
        return cursor.layout(names, stamp_at, found)

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message."""
        found = object_of(message)
        names = names_of(found.get("joint_names"), "joint_names")
        interfaces = found.get("interface_values")
        if not isinstance(interfaces, list) or len(interfaces) != len(names):
            raise MessageError("interface_values and joint_names differ in length")
        tables = {quantity: np.full((1, len(names)), np.nan) for quantity in QUANTITIES}
        for joint, one in enumerate(interfaces):
            if not isinstance(one, dict) or not isinstance(one.get("interface_names"), list):
                raise MessageError("interface_values contains a value that is not an interface")
            kinds = one["interface_names"]
            values = values_of(one.get("values"), "interface_values.values", len(kinds))
            for column, kind in enumerate(kinds):
                if kind in QUANTITIES and values is not None:
                    tables[kind][0, joint] = values[0, column]
        stamp, bad = stamp_of(found.get("header"))
        filled = {q: None if np.isnan(t).all() else t for q, t in tables.items()}
        return Batch(np.array([row]), tuple(names), np.array([stamp]), bad, filled)


class Float64MultiArray(_OneLayout):
    """``std_msgs/msg/Float64MultiArray``: setpoints of a forward command controller.

    The labels of ``layout.dim`` name the joints if there is one for each value; otherwise the
    joints are numbered ``0``, ``1``, ... The type does not state a quantity: position, velocity
    and effort all contain the values.
    """

    def _layout(self, cursor: Cursor) -> Layout:
        dimensions = cursor.count("layout.dim")
        if dimensions > _DIMENSIONS:
            raise MessageError(f"{dimensions} dimensions")
        labels = []
        for _ in range(dimensions):
            labels.append(cursor.text("a dimension's label"))
            cursor.skip(8, "layout.dim")
        cursor.skip(4, "layout.data_offset")
        values = cursor.doubles("data")
        cursor.end()
        names = _array_names(labels, len(values))
        return cursor.layout(names, None, dict.fromkeys(QUANTITIES, values))

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message."""
        found = object_of(message)
        data = found.get("data")
        if not isinstance(data, list):
            raise MessageError("data is not a list")
        layout = found.get("layout")
        dim = layout.get("dim") if isinstance(layout, dict) else None
        labels = [d.get("label") for d in dim if isinstance(d, dict)] if dim else []
        names = _array_names([label for label in labels if isinstance(label, str)], len(data))
        check_names(names)
        values = values_of(data, "data", len(names))
        return Batch(
            np.array([row]),
            tuple(names),
            np.zeros(1, np.int64),
            0,
            dict.fromkeys(QUANTITIES, values),
        )


_DIMENSIONS = 1024
"""Largest number of dimensions in the layout of an array message."""


def _array_names(labels: list[str], count: int) -> list[str]:
    if len(labels) == count and len(set(labels)) == count and all(labels):
        return labels
    return [str(place) for place in range(count)]


@dataclass(frozen=True)
class JointTrajectory:
    """``trajectory_msgs/msg/JointTrajectory``: setpoints at times after the message's time.

    Attributes:
        in_goals: whether the messages are goals of ROS 1's ``FollowJointTrajectory`` action.
    """

    in_goals: bool = False

    def serialized(
        self, data: bytes, starts: Integers, sizes: Integers, encoding: Encoding
    ) -> Iterator[Decoded]:
        """Decode many messages."""
        return decode_trajectories(data, starts, sizes, encoding, in_goals=self.in_goals)

    def from_json(self, message: bytes, row: int) -> Batch:
        """Decode one message."""
        found = object_of(message)
        if self.in_goals:
            goal = found.get("goal")
            inner = goal.get("trajectory") if isinstance(goal, dict) else None
            if not isinstance(inner, dict):
                raise MessageError("goal.trajectory is not an object")
            found = inner
        if not found.get("joint_names") and not found.get("points"):
            return trajectory_from_json(found | {"points": []}, [], row)
        return trajectory_from_json(found, names_of(found.get("joint_names"), "joint_names"), row)


ANY_QUANTITY = frozenset({"std_msgs/msg/Float64MultiArray"})
"""Message types that do not state the quantity of their values."""
GOAL = "control_msgs/msg/FollowJointTrajectoryActionGoal"
"""ROS 1's goal of the action that sends a trajectory."""
TRAJECTORIES = frozenset({"trajectory_msgs/msg/JointTrajectory", GOAL})
"""Message types whose messages replace the remaining setpoints of the message before."""


def encodings_of(schema: str) -> tuple[str, ...]:
    """Return the message encodings in which a type is read."""
    return ("protobuf", "json") if schema == foxglove.SCHEMA_NAME else ("cdr", "ros1", "json")


def message_type(schema: str, role: str) -> MessageType | None:
    """Return the decoder of a type for a role (``state``, ``command``); None for other types."""
    match long_name(schema):
        case joint_state.SCHEMA_NAME:
            return JointState()
        case foxglove.SCHEMA_NAME:
            return foxglove.FoxgloveJointStates()
        case "control_msgs/msg/JointTrajectoryControllerState":
            return ControllerState(role)
        case "control_msgs/msg/DynamicJointState":
            return DynamicJointState()
        case "std_msgs/msg/Float64MultiArray" if role == "command":
            return Float64MultiArray()
        case "trajectory_msgs/msg/JointTrajectory" if role == "command":
            return JointTrajectory()
        case other if other == GOAL and role == "command":
            return JointTrajectory(in_goals=True)
    return None


def long_name(schema: str) -> str:
    """Return a type name as ``package/msg/Type``, also for ROS 1's ``package/Type``."""
    package, separator, name = schema.partition("/")
    return f"{package}/msg/{name}" if separator and "/" not in name else schema


def known_types(role: str) -> str:
    """Return the types that a role accepts, as text for a message."""
    names = [
        joint_state.SCHEMA_NAME,
        foxglove.SCHEMA_NAME,
        "control_msgs/msg/JointTrajectoryControllerState",
        "control_msgs/msg/DynamicJointState",
    ]
    if role == "command":
        names += ["std_msgs/msg/Float64MultiArray", "trajectory_msgs/msg/JointTrajectory", GOAL]
    return ", ".join(names)
