"""Contact effects: between moving links and fixed geoms of the surroundings.

They act on geoms that come close to each other in the recordings (:mod:`contact_geoms`), through
MuJoCo's contact model: normal acceleration -b v - k r at penetration r, friction within a cone.
Other contacts of the same geoms change too.
"""

from __future__ import annotations

from typing import ClassVar

from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values

_IN_THE_AIR = "repeat the motion without contact: a contact effect disappears"
_TWO_FORCES = (
    "press with two forces: the deflection of a spring grows in proportion, an offset stays"
)


class ContactOffset(Effect):
    """A contact surface is at another place than in the model."""

    id = "contact_offset"
    family = "contact"
    stage = "contact"
    law = (
        "surface moved by offset along its normal; "
        "normal: z axis of a plane or height field, face of a box that the robot touches, mean "
        "contact direction of other geoms"
    )
    source = "Siciliano, Khatib, Springer Handbook of Robotics (2016), ch. 37: contact modeling"
    scope = "robot"
    parameters = (
        Parameter(
            "offset", "length", 0.0, -5.0, 5.0, (0.3, -0.3, 1.0, -1.0, 3.0), "clearance", step=0.02,
            meaning="offset of the surface along its normal",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "contact_stiffness": _TWO_FORCES,
        "encoder_bias": _IN_THE_AIR,
        "base_tilt": _IN_THE_AIR,
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_offset = fields.contact_offset + values["offset"][:, 0]


class ContactStiffness(Effect):
    """The contact is stiffer or softer than in the model."""

    id = "contact_stiffness"
    family = "contact"
    stage = "contact"
    law = "contact stiffness times 1 + relative_error, contact damping unchanged"
    source = "Todorov, ICRA (2014): convex and analytically-invertible dynamics with contacts"
    scope = "robot"
    parameters = (
        Parameter(
            "relative_error", "one", 0.0, -0.95, 20.0, (0.5, -0.5, 3.0), step=0.05,
            meaning="contact stiffness", relation="relative",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "contact_offset": _TWO_FORCES,
        "contact_damping": "press against the surface without moving: damping has no effect",
        "joint_elasticity": "load the joint without contact, with a weight on the link",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_stiffness = fields.contact_stiffness + values["relative_error"][:, 0]


class ContactDamping(Effect):
    """Impacts dissipate more or less energy than in the model."""

    id = "contact_damping"
    family = "contact"
    stage = "contact"
    law = (
        "contact damping times 1 + relative_error, contact stiffness unchanged; "
        "the damping also slows slip within the friction cone"
    )
    source = "Hunt, Crossley, J. Appl. Mech. 42 (1975): restitution as damping in vibroimpact"
    scope = "robot"
    parameters = (
        Parameter(
            "relative_error", "one", 0.0, -0.95, 10.0, (0.5, -0.5, 3.0), step=0.05,
            meaning="contact damping", relation="relative",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "contact_stiffness": "press against the surface without moving: damping has no effect",
        "viscous_friction": _IN_THE_AIR,
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_damping = fields.contact_damping + values["relative_error"][:, 0]


class ContactFriction(Effect):
    """Sliding friction of the contact differs from the model's."""

    id = "contact_friction"
    family = "contact"
    stage = "contact"
    law = "|tangential force| <= (mu + coefficient) normal force; sliding only, mu at least 0"
    source = "Stewart, Trinkle, Int. J. Numer. Meth. Eng. 39 (1996): Coulomb friction in steps"
    scope = "robot"
    parameters = (
        Parameter(
            "coefficient", "one", 0.0, -1.5, 2.0, (0.1, -0.1, 0.5), step=0.02,
            meaning="friction coefficient of the contact", relation="added",
        ),
    )  # fmt: skip
    confused_with: ClassVar = {
        "coulomb_friction": _IN_THE_AIR,
        "contact_damping": "slide at two speeds: friction does not depend on speed",
        "contact_offset": "slide in both directions under one force: friction changes its sign",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_friction = fields.contact_friction + values["coefficient"][:, 0]
