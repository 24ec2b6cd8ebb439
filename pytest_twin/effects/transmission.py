"""Transmission: what stands between the drive and the link, short of extra degrees of freedom."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values, World


class JointSpring(Effect):
    """A passive spring at the joint: a balancer, a cable bundle, a seal."""

    id = "joint_spring"
    family = "transmission"
    law = "effort = -stiffness (q - rest), written as preload - stiffness q"
    source = "Siciliano et al., Robotics (2009), sec. 7.2"
    parameters = (
        Parameter("stiffness", "stiffness", 0.0, -2.0, 20.0, (0.1,), "stiffness"),
        Parameter("preload", "effort", 0.0, -10.0, 10.0, (0.1,), "effort"),
    )
    confused_with: ClassVar = {
        "controller_gain": "the drive off: only a spring pulls",
        "base_tilt": "another joint's pose: a spring does not feel it",
        "encoder_bias": "poses far apart",
        "asymmetric_friction": "poses far apart",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.stiffness += values["stiffness"]
        fields.constant_force += values["preload"]


class JointCoupling(Effect):
    """The drive of the joint before moves this one too: a differential, a routed cable."""

    id = "joint_coupling"
    family = "transmission"
    law = "delivered_j += ratio drive_(j-1)"
    source = "Siciliano et al., Robotics (2009), sec. 5.1: transmissions that couple joints"
    parameters = (Parameter("ratio", "one", 0.0, -2.0, 2.0, (0.1,)),)
    confused_with: ClassVar = {
        "inertial_parameters": "hold the other joint still under load: only a coupling pulls",
    }

    def drive(self, world: World, values: Values) -> None:
        before = np.zeros_like(world.delivered)
        before[:, 1:] = world.delivered[:, :-1]
        world.delivered = world.delivered + values["ratio"] * before


__all__ = ["JointCoupling", "JointSpring"]
