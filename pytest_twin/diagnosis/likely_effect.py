"""The most likely effect of a quick diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from pytest_twin.diagnosis.patched.model import AppliedEffect

Place = tuple[str, tuple[str, ...]]
"""An effect and the names of its joints; no joints for an effect of the robot."""


@dataclass(frozen=True, slots=True)
class LikelyEffect:
    """The most likely effect.

    Attributes:
        place: the effect and its joints.
        values: reported name of a parameter -> (value, unit), at the first joint.
        posterior_share: posterior share among the fitted candidates, 0 to 1.
        removed_share: share of the squared error of the examined part that it removes.
        alternatives: other effects that explain the recording about as well, best first.
        explained_joints: joints whose errors it was fitted to explain; empty for all joints.
        fitted: the effect at each of its joints, with all parameters.
    """

    place: Place
    values: dict[str, tuple[float, str]]
    posterior_share: float
    removed_share: float
    alternatives: tuple[Place, ...] = ()
    explained_joints: tuple[str, ...] = ()
    fitted: tuple[AppliedEffect, ...] = ()
