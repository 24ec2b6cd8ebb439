"""Compare two compiled forms of a robot, feature by feature."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from pytest_twin.asset.loss import behaviour, bodies, joints
from pytest_twin.asset.loss.description import Description, Dynamics
from pytest_twin.asset.loss.matrix import Conversion
from pytest_twin.asset.loss.table import equality_row, presence_row

POSES = 5
"""Number of random poses at which dynamics are compared, in addition to the reference."""
_REACH = math.pi


def compare(
    source: Description, target: Description, reference: Dynamics, reference_name: str
) -> Conversion:
    """Compute all rows of one conversion.

    Args:
        source, target: the robot before and after the conversion.
        reference: the source robot in a different engine than the target's.
        reference_name: name of that engine.
    """
    poses = configurations(source, reference, target.dynamics)
    rows = [
        *behaviour.rows(source, target, reference, reference_name, poses),
        bodies.links(source, target),
        joints.joints(source, target),
        joints.degrees_of_freedom(source, target),
        joints.passive_joints(source, target),
        joints.actuators(source, target),
        *joints.limits(source, target),
        joints.passive_terms(source, target),
        equality_row("drives", source.drives, target.drives, "feedback terms of the actuators"),
        joints.mimics(source, target),
        joints.constraints(source, target),
        bodies.shapes(source, target),
        bodies.disabled_pairs(source, target),
        bodies.contact(source, target),
        bodies.sensors(source, target),
        bodies.frames(source, target),
        presence_row(
            "custom tags",
            {name: f"{count} times" for name, count in source.custom.items()},
            dict.fromkeys(target.custom, ""),
            "elements of the target's model",
        ),
        joints.transmissions(source, target),
        presence_row("safety controllers", source.safety, target.safety, "soft limits of joints"),
    ]
    known = {row.feature for row in rows}
    rows += [
        presence_row(
            feature,
            values,
            target.stated.get(feature, {}),
            "elements and attributes of the target's model",
        )
        for feature, values in source.stated.items()
        if feature not in known
    ]
    return Conversion(source.name, target.name, target.engine, tuple(rows))


def configurations(
    source: Description, *dynamics: Dynamics, count: int = POSES
) -> list[dict[str, float]]:
    """Return zeros and ``count`` random configurations within limits and mimic laws, rad or m.

    Only joints that exist in all ``dynamics`` get a value.
    """
    shared = [name for name in source.dynamics.joints if all(name in d.joints for d in dynamics)]
    generator = np.random.default_rng(20240229)
    found: list[dict[str, float]] = [dict.fromkeys(shared, 0.0)]
    for _ in range(count):
        drawn = {}
        for name in shared:
            lower, upper = source.joints[name].range or (-_REACH, _REACH)
            lower, upper = max(lower, -_REACH), min(upper, _REACH)
            drawn[name] = float(generator.uniform(min(lower, upper), max(lower, upper)))
        for name in shared:
            drawn[name] = _with_mimics(source.mimics, drawn, name)
        found.append(drawn)
    return found


def _with_mimics(
    mimics: Mapping[str, tuple[str, float, float]], drawn: Mapping[str, float], name: str
) -> float:
    if name not in mimics:
        return drawn[name]
    leader, multiplier, offset = mimics[name]
    if leader not in drawn:
        return drawn[name]
    return multiplier * _with_mimics(mimics, drawn, leader) + offset
