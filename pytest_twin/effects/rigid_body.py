"""Rigid-body effects: masses, inertia, and the direction of gravity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.effects.base import (
    MODES,
    Effect,
    ModelFields,
    Parameter,
    RegressorColumn,
    Values,
)

if TYPE_CHECKING:
    from pytest_twin.effects.layout import Layout

_INERTIA_ONLY = 2.0
"""Form of ``inertial_parameters`` in which only the inertia differs."""


class Payload(Effect):
    """A point mass on the last link that the model lacks."""

    id = "payload"
    family = "rigid_body"
    stage = "gravity"
    basic_modes = MODES
    nearly_linear = True
    law = (
        "point mass at distance along the last link's direction, from its joint; "
        "form 1: also sideways, in the joint's direction of motion; "
        "form 2: also across, perpendicular to both; "
        "link direction: from the joint to the link's centre of mass, for a flange the joint's axis"
    )
    source = "Khalil, Dombre, Modeling, Identification and Control of Robots (2002), ch. 12"
    scope = "robot"
    parameters = (
        Parameter(
            "mass", "mass", 0.0, -0.9, 20.0, (0.2,), "mass", meaning="payload mass",
            relation="added",
        ),
        Parameter(
            "distance", "length", None, -2.0, 4.0, (0.5, 1.0, 2.0), "length",
            meaning="distance from the last joint along the link",
        ),
        Parameter(
            "sideways", "length", None, -4.0, 4.0, (-0.5, 0.5), "length",
            under=("form", (1.0, 2.0)), meaning="offset in the joint's direction of motion",
        ),
        Parameter(
            "across", "length", None, -4.0, 4.0, (-0.5, 0.5), "length", under=("form", (2.0,)),
            meaning="offset perpendicular to link and motion",
        ),
        Parameter(
            "form", "one", None, 0.0, 2.0, (0.0, 1.0, 2.0), choice=True,
            meaning="free coordinates of the mass",
            choices=("on the link's axis", "beside the link's axis", "anywhere around the link"),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "inertial_parameters": "remove the payload and repeat the recording",
        "torque_constant": "repeat the recording with a known mass added",
        "base_tilt": "hold poses on both sides of the vertical",
    }

    def coordinates(self, parameters: FloatArray) -> FloatArray:
        """First moment and distance: gravity depends on the moment, inertia on their product."""
        mass, distance, *others, form = parameters
        # Beside the link's axis a mass has a moment at zero distance too.
        return parameters if form else np.array([mass * distance, distance, *others, form])

    def from_coordinates(self, coordinates: FloatArray) -> FloatArray:
        """Mass and distance; at zero distance the moment and so the mass is zero."""
        moment, distance, *others, form = coordinates
        mass = moment / distance if distance else 0.0
        return coordinates if form else np.array([mass, distance, *others, form])

    def fields(self, fields: ModelFields, values: Values) -> None:
        # A robot parameter is repeated in every joint's column; the mass is on the last link.
        fields.added_mass[:, -1] += values["mass"][:, -1]
        at = [values[name][:, -1] for name in ("distance", "sideways", "across")]
        fields.added_at[:, -1] = np.stack(at, axis=1)


class InertialParameters(Effect):
    """The mass, centre of mass or inertia of the link differs from the model's.

    Every form is physically consistent: positive mass, and moments of inertia about the centre of
    mass that keep their ratios.
    """

    id = "inertial_parameters"
    family = "rigid_body"
    nearly_linear = True
    law = (
        "form 0: mass and inertia times 1 + relative_error; "
        "form 1: mass times 1 + mass_error; "
        "form 2: inertia about the centre of mass times 1 + inertia_error; "
        "form 3: forms 1 and 2, and the centre of mass moved away from the joint's axis (radial) "
        "and in the joint's direction of motion (tangential)"
    )
    source = "Wensing, Kim, Slotine, IEEE RA-L 3 (2018): physical consistency"
    parameters = (
        Parameter(
            "relative_error", "one", 0.0, -0.9, 4.0, (0.1,), under=("form", (0.0,)),
            meaning="mass and inertia of the link", relation="relative",
        ),
        Parameter(
            "mass_error", "one", 0.0, -0.9, 4.0, (0.1,), under=("form", (1.0, 3.0)),
            meaning="mass of the link", relation="relative",
        ),
        Parameter(
            "inertia_error", "one", 0.0, -0.9, 9.0, (0.1,), under=("form", (2.0, 3.0)),
            meaning="inertia of the link about its centre of mass", relation="relative",
        ),
        Parameter(
            "radial", "length", 0.0, -2.0, 2.0, (0.1,), "gyration", under=("form", (3.0,)),
            meaning="shift of the centre of mass away from the joint's axis",
        ),
        Parameter(
            "tangential", "length", 0.0, -2.0, 2.0, (0.1,), "gyration", under=("form", (3.0,)),
            meaning="shift of the centre of mass in the joint's direction of motion",
        ),
        Parameter(
            "form", "one", None, 0.0, 3.0, (0.0, 1.0, 2.0, 3.0), choice=True,
            meaning="free inertial parameters",
            choices=(
                "mass and inertia by the same factor", "mass only", "inertia only",
                "mass, inertia and centre of mass",
            ),
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "payload": "remove the payload and repeat the recording",
        "torque_constant": "repeat the recording with a known mass added",
        "armature": "hold the joint against gravity: armature has no weight",
    }

    def equivalents(
        self, values: Mapping[str, float], layout: Layout, model: mujoco.MjModel, joint: int
    ) -> Mapping[str, Mapping[str, float]]:
        """A payload for the last link; armature for an inertia about a hinge."""
        found = {}
        if joint == len(layout.joints) - 1:
            found["payload"] = self._as_payload(values, layout, model)
        if values["form"] == _INERTIA_ONLY and not layout.slides[joint]:
            found["armature"] = self._as_armature(values, layout, model, joint)
        return {effect: own for effect, own in found.items() if own}

    @staticmethod
    def _as_payload(
        values: Mapping[str, float], layout: Layout, model: mujoco.MjModel
    ) -> Mapping[str, float]:
        """A point mass with the added mass and first moment; empty where no mass is added."""
        mass = float(model.body_mass[layout.body_index[-1]])
        added = values["mass_error"] * mass
        if not added:
            return {}
        last = np.array([len(layout.joints) - 1])
        radial, tangential = np.array([values["radial"]]), np.array([values["tangential"]])
        (moved,), (axes,) = layout.center_shift(radial, tangential, last), layout.payload_axes(last)
        center = layout.link_length[-1] * layout.directions[-1]
        at = axes @ (center + (mass + added) / added * moved)
        return {"mass": added, **dict(zip(("distance", "sideways", "across"), at, strict=True))}

    @staticmethod
    def _as_armature(
        values: Mapping[str, float], layout: Layout, model: mujoco.MjModel, joint: int
    ) -> Mapping[str, float]:
        """A rotor with the added inertia about the joint's axis.

        The motion is the same where no joint before it turns the link about that axis.
        """
        body = layout.body_index[joint]
        axis, back = np.zeros(3), np.zeros(4)
        mujoco.mju_negQuat(back, model.body_iquat[body])
        mujoco.mju_rotVecQuat(axis, model.jnt_axis[layout.joint_ids[joint]], back)
        return {"inertia": values["inertia_error"] * float(model.body_inertia[body] @ axis**2)}

    def fields(self, fields: ModelFields, values: Values) -> None:
        whole = 1.0 + values["relative_error"]
        fields.mass_scale *= whole * (1.0 + values["mass_error"])
        fields.inertia_scale *= whole * (1.0 + values["inertia_error"])
        fields.center_radial += values["radial"]
        fields.center_tangential += values["tangential"]


class Armature(Effect):
    """Reflected inertia of rotor and gear at the joint."""

    id = "armature"
    family = "rigid_body"
    stage = "inertia"
    basic_modes = MODES
    mjcf_field = "armature"
    regressor_symbol = "Ia"
    nearly_linear = True
    law = "effort = -inertia dv/dt; inertia = rotor inertia times gear ratio squared"
    source = "Siciliano et al., Robotics (2009), sec. 7.2"
    parameters = (
        Parameter(
            "inertia", "inertia", 0.0, -0.95, 20.0, (0.1,), "inertia",
            meaning="armature (reflected rotor inertia)", relation="added",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "inertial_parameters": "hold the joint against gravity: armature has no weight",
        "actuator_lag": "repeat the recording with two payloads: a lag does not depend on the "
        "payload",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.armature += values["inertia"]

    def regressor_column(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray
    ) -> RegressorColumn:
        return RegressorColumn(acceleration, by_acceleration=1.0)


class BaseTilt(Effect):
    """The base is not level."""

    id = "base_tilt"
    family = "rigid_body"
    nearly_linear = True
    law = "gravity in the base frame = Ry(pitch)^T Rx(roll)^T gravity of a level base"
    source = "Mooring, Roth, Driels, Fundamentals of Manipulator Calibration (1991)"
    scope = "robot"
    parameters = (
        Parameter("roll", "angle", 0.0, -0.6, 0.6, (0.03,), meaning="roll about x"),
        Parameter("pitch", "angle", 0.0, -0.6, 0.6, (0.03,), meaning="pitch about y"),
    )
    confused_with: ClassVar = {
        "encoder_bias": "measure the base with a spirit level, or turn the first joint by half a "
        "turn",
        "joint_spring": "change another joint's pose: only the effort of a tilt changes",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        roll, pitch = values["roll"][:, 0], values["pitch"][:, 0]
        x, y, z = fields.gravity.T.copy()
        # gravity_base = Ry(pitch)^T Rx(roll)^T gravity_level
        y, z = np.cos(roll) * y + np.sin(roll) * z, -np.sin(roll) * y + np.cos(roll) * z
        x, z = np.cos(pitch) * x - np.sin(pitch) * z, np.sin(pitch) * x + np.cos(pitch) * z
        fields.gravity[:] = np.stack([x, y, z], axis=1)
