"""Find the topics of a recording that could contain its states and its commands."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_twin.formats.recording import Recording, Topic

_CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
_PAIRS = 4
"""Largest number of proposed pairs of topics."""
_LISTED = 8
"""Largest number of topics in a message."""
_JOINTS = 6
"""Largest number of joints in a message."""


def pairs(recording: Recording) -> list[tuple[Topic, Topic]]:
    """Return pairs of state and command topics with a joint in common, most likely first.

    A topic that was already read for a role keeps that role.
    """
    fixed = {role: series.topic for role, series in recording.series.items()}
    known = [topic for topic in recording.topics if topic.joints]

    def choices(role: str) -> list[Topic]:
        if role in fixed:
            return [topic for topic in known if topic.name == fixed[role]]
        others = [topic for topic in known if role in topic.roles]
        return [t for t in others if role != "state" or "position" in t.filled]

    found = [
        (state, command)
        for state in choices("state")
        for command in choices("command")
        if _are_compatible(state, command)
    ]
    return sorted(found, key=lambda pair: -_likelihood(*pair))


def topics_option(state: Topic, command: Topic) -> str:
    """Return the command-line option that selects a pair of topics."""
    return f"--topics state={state.name},command={command.name}"


def describe(topic: Topic) -> str:
    """Describe a topic with its number of messages, type and joints."""
    more = f" and {len(topic.joints) - _JOINTS} more" if len(topic.joints) > _JOINTS else ""
    joints = ", ".join(topic.joints[:_JOINTS]) + more
    of_joints = f" of {joints}" if joints else ""
    return f"{topic.name} ({topic.messages} {topic.type or 'messages without a type'}{of_joints})"


def what_to_do(recording: Recording, role: str) -> str:
    """Return advice for an error: the candidate topics and the option that selects each pair."""
    others = {series.topic for other, series in recording.series.items() if other != role}
    fits = [
        topic
        for topic in recording.topics
        if topic.joints and role in topic.roles and topic.name not in others
    ]
    if not recording.topics:
        column = "command" if role == "command" else "position"
        return f"{role}s in the file: a topic, or columns NAME.{column} of a CSV file"
    if not fits:
        names = ", ".join(topic.name for topic in recording.topics[:_LISTED])
        return f"a topic with joints; it has {names}"
    text = ("one of " if len(fits) > 1 else "") + "; ".join(map(describe, fits[:_LISTED]))
    options = _options(pairs(recording))
    return f"{text}; to read it: {' or '.join(options)}" if options else text


def _options(found: Sequence[tuple[Topic, Topic]]) -> list[str]:
    return [topics_option(*pair) for pair in found[:_PAIRS]]


def _are_compatible(state: Topic, command: Topic) -> bool:
    if state.name == command.name:
        return state.type == _CONTROLLER_STATE
    by_place = all(name.isdecimal() for name in command.joints)
    return by_place or bool(set(state.joints) & set(command.joints))


def _likelihood(state: Topic, command: Topic) -> int:
    """Score a pair by the names and types that drivers and controllers usually have."""
    last = command.name.rpartition("/")[2]
    return (
        4 * (state.name.endswith("joint_states"))
        + 2 * (len(state.filled) > 1)
        + 4 * ("command" in command.name)
        + 3 * (command.type.startswith(("std_msgs", "trajectory_msgs")))
        + 2 * (command.type == _CONTROLLER_STATE)
        - 4 * ("state" in last and command.type != _CONTROLLER_STATE)
    )
