"""Motions that determine parameters which recordings do not, and how to design them."""

from __future__ import annotations

from collections.abc import Mapping

from pytest_twin.effects import effect_of_field
from pytest_twin.identification.stages import StageName

_MECHANISMS: Mapping[StageName, str] = {
    "delay": "delay",
    "encoder": "gravity",
    "gravity": "gravity",
    "inertia": "inertia",
    "friction": "friction",
    "drive": "friction",
    "closed_loop": "closed_loop",
}
"""Stage -> mechanism of ``pytest-twin excite`` whose motions determine its parameters."""


def undetermined_by_effort(
    expression: str, stage: StageName, joint: str, kind: str
) -> dict[str, str]:
    """Return an entry of ``unobservable`` for a parameter of the inverse dynamics.

    Args:
        expression: the parameter's name in the record.
        stage: stage that fits it.
        joint, kind: joint and kind of its first column.
    """
    return entry(expression, _motion(stage, joint, kind), _MECHANISMS[stage])


def undetermined_by_command(stage: StageName, place: str, effect: str) -> dict[str, str]:
    """Return an entry of ``unobservable`` for an effect of the closed loop.

    Args:
        stage: stage that fits it.
        place: joint, or ``robot``.
    """
    joint = "each joint" if place == "robot" else place
    motion, mechanism = _OF_COMMANDS[stage]
    return entry(f"{place}.{effect}", motion.format(joint), mechanism)


def entry(expression: str, motion: str, mechanism: str) -> dict[str, str]:
    """Return an entry of ``unobservable`` in ``identification.json``."""
    return {"expression": expression, "motion": motion, "mechanism": mechanism}


_OF_COMMANDS: Mapping[StageName, tuple[str, str]] = {
    "delay": ("command quick steps of {}, with rests between them", "delay"),
    "encoder": ("hold poses over the whole range of {}, reached from both sides", "gravity"),
    "gravity": (
        "hold poses in which gravity acts on the last link from several sides", "gravity",
    ),
    "inertia": ("command a chirp of {} up to its highest frequency", "closed_loop"),
    "friction": ("move {} slowly to and fro at several speeds", "friction"),
    "drive": ("command a chirp of {}, and hold poses at several loads", "closed_loop"),
}  # fmt: skip
"""Stage -> motion, and mechanism of ``pytest-twin excite`` that has it."""


def _motion(stage: StageName, joint: str, kind: str) -> str:
    if stage == "gravity":
        return f"hold poses in which gravity acts on the link of {joint} from several sides"
    if stage == "inertia":
        return f"accelerate {joint}, and the joints before it, in several poses at once"
    if kind.endswith(effect_of_field("damping").id):
        return f"move {joint} at two constant speeds a factor of four apart, both ways"
    if stage == "friction":
        return f"move {joint} slowly to and fro over the same path"
    return f"move {joint} both ways at several loads"
