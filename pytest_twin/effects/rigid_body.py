"""Rigid body: masses, inertia, and which way is down."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values


class Payload(Effect):
    """A mass on the last link that the model does not carry."""

    id = "payload"
    family = "rigid_body"
    law = (
        "mass on the last link, a point at distance along the link's own direction (from its joint "
        "to its centre of mass, or, where that is within 0.03 of the arm's length and nearer to "
        "the joint's axis than across it, as a flange's is, along that axis); "
        "form 1: and sideways, the way that the joint turns it there; "
        "form 2: and across both"
    )
    source = "Khalil, Dombre, Modeling, Identification and Control of Robots (2002), ch. 12"
    scope = "robot"
    parameters = (
        Parameter("mass", "mass", 0.0, -0.9, 20.0, (0.2,), "mass"),
        Parameter("distance", "length", None, -2.0, 4.0, (0.5, 1.0, 2.0), "length"),
        Parameter(
            "sideways", "length", None, -4.0, 4.0, (-0.5, 0.5), "length", under=("form", (1.0, 2.0))
        ),
        Parameter(
            "across", "length", None, -4.0, 4.0, (-0.5, 0.5), "length", under=("form", (2.0,))
        ),
        Parameter("form", "one", None, 0.0, 2.0, (0.0, 1.0, 2.0), choice=True),
    )
    confused_with: ClassVar = {
        "inertial_parameters": "take the payload off",
        "torque_constant": "the same motion with a known mass added",
        "base_tilt": "poses on both sides of the vertical",
    }

    def coordinates(self, parameters: FloatArray) -> FloatArray:
        """First moment and distance: weight follows the one, inertia their product."""
        mass, distance, *others, form = parameters
        # Beside the link's own direction a load has a moment at no distance.
        return parameters if form else np.array([mass * distance, distance, *others, form])

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """Mass and distance; a mass at no distance has no moment."""
        moment, distance, *others, form = coordinates
        mass = moment / distance if distance else 0.0
        return coordinates if form else np.array([mass, distance, *others, form])

    def fields(self, fields: ModelFields, values: Values) -> None:
        # A robot's parameter stands in every joint's column; the mass sits on the last link.
        fields.added_mass[:, -1] += values["mass"][:, -1]
        at = [values[name][:, -1] for name in ("distance", "sideways", "across")]
        fields.added_at[:, -1] = np.stack(at, axis=1)


class InertialParameters(Effect):
    """The link that the joint moves is not as its drawing has it.

    Every form leaves a link that can exist: positive mass, and moments of inertia about the centre
    of mass that stay in proportion.
    """

    id = "inertial_parameters"
    family = "rigid_body"
    law = (
        "form 0: mass and inertia of the link times 1 + relative_error; "
        "form 1: mass alone times 1 + mass_error; "
        "form 2: inertia about the centre of mass alone times 1 + inertia_error; "
        "form 3: both, and the centre moved away from the axis (radial) and the way that the joint "
        "turns it (tangential)"
    )
    source = "Wensing, Kim, Slotine, IEEE RA-L 3 (2018): physical consistency"
    parameters = (
        Parameter("relative_error", "one", 0.0, -0.9, 4.0, (0.1,), under=("form", (0.0,))),
        Parameter("mass_error", "one", 0.0, -0.9, 4.0, (0.1,), under=("form", (1.0, 3.0))),
        Parameter("inertia_error", "one", 0.0, -0.9, 9.0, (0.1,), under=("form", (2.0, 3.0))),
        Parameter("radial", "length", 0.0, -2.0, 2.0, (0.1,), "gyration", under=("form", (3.0,))),
        Parameter(
            "tangential", "length", 0.0, -2.0, 2.0, (0.1,), "gyration", under=("form", (3.0,))
        ),
        Parameter("form", "one", None, 0.0, 3.0, (0.0, 1.0, 2.0, 3.0), choice=True),
    )
    confused_with: ClassVar = {
        "payload": "take the payload off",
        "torque_constant": "the same motion with a known mass added",
        "armature": "hold against gravity: armature has no weight",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        whole = 1.0 + values["relative_error"]
        fields.mass_scale *= whole * (1.0 + values["mass_error"])
        fields.inertia_scale *= whole * (1.0 + values["inertia_error"])
        fields.center_radial += values["radial"]
        fields.center_tangential += values["tangential"]


class Armature(Effect):
    """Inertia of rotor and gears, as the joint feels it."""

    id = "armature"
    family = "rigid_body"
    of_every_drive = True
    law = "effort = -armature dv/dt; armature = rotor inertia times ratio squared"
    source = "Siciliano et al., Robotics (2009), sec. 7.2"
    parameters = (Parameter("inertia", "inertia", 0.0, -0.95, 20.0, (0.1,), "inertia"),)
    confused_with: ClassVar = {
        "inertial_parameters": "hold against gravity: armature has no weight",
        "actuator_lag": "two payloads",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.armature += values["inertia"]


class BaseTilt(Effect):
    """The base does not stand level."""

    id = "base_tilt"
    family = "rigid_body"
    law = "gravity in the base frame turned by roll about x, then pitch about y"
    source = "Mooring, Roth, Driels, Fundamentals of Manipulator Calibration (1991)"
    scope = "robot"
    parameters = (
        Parameter("roll", "angle", 0.0, -0.6, 0.6, (0.03,)),
        Parameter("pitch", "angle", 0.0, -0.6, 0.6, (0.03,)),
    )
    confused_with: ClassVar = {
        "encoder_bias": "a level on the base; a turn of the first joint",
        "joint_spring": "another joint's pose",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        roll, pitch = values["roll"][:, 0], values["pitch"][:, 0]
        x, y, z = fields.gravity.T.copy()
        # gravity_base = Ry(pitch)^T Rx(roll)^T gravity_level
        y, z = np.cos(roll) * y + np.sin(roll) * z, -np.sin(roll) * y + np.cos(roll) * z
        x, z = np.cos(pitch) * x - np.sin(pitch) * z, np.sin(pitch) * x + np.cos(pitch) * z
        fields.gravity[:] = np.stack([x, y, z], axis=1)
