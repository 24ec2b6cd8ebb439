"""Effects that no recording of a case can distinguish from the hidden effect.

A diagnosis that names one of them first is right only if it gives the hidden effect a similar
confidence (``score.py``). The pairs are structurally equivalent; pairs that are similar on some
motions only are not listed.
"""

from __future__ import annotations

from typing import Any

from plant import Hidden
from robots import Robot

Named = tuple[str, int]
"""Effect, and the joint's index; -1 for the whole robot."""


def equivalents(effect: str, joint: int, hidden: Hidden, robot: Robot) -> list[Named]:
    """Return other (effect, joint) that cause the same recordings, except at their beginning."""
    alone = len(robot.joints) == 1
    parameters: dict[str, Any] = hidden.effects[effect][joint]
    found: list[Named] = []
    if effect == "command_delay" and alone:
        found.append(("sensor_delay", -1))
    if effect == "sensor_delay" and alone:
        found.append(("command_delay", 0))
    if effect == "torque_constant" and robot.mode in ("position", "velocity"):
        found.append(("controller_gain", joint))  # both of its gains by the same factor
    if effect == "controller_gain" and robot.mode == "velocity":
        found.append(("torque_constant", joint))
    first = robot.joints[0]
    hinge = not first.slide and not first.axis[2]
    if effect == "encoder_bias" and joint == 0 and hinge and parameters.get("in_loop"):
        found.append(("base_tilt", -1))
    if effect == "base_tilt" and alone and hinge:
        found.append(("encoder_bias", 0))
    return found
