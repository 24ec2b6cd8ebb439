"""Contact between the robot and what stands still around it.

They act on geoms that come near each other in the recordings (:mod:`contact_geoms`), by the
engine's own contact model: normal acceleration -b v - k r at penetration r, friction within a cone.
Where a robot's geom shares a contact with something else, that contact changes too.
"""

from __future__ import annotations

from typing import ClassVar

from pytest_twin.effects.base import Effect, ModelFields, Parameter, Values

_IN_THE_AIR = "the same motion in the air: without contact it is gone"


class ContactOffset(Effect):
    """A surface does not stand where the model has it."""

    id = "contact_offset"
    family = "contact"
    law = (
        "surface moved by offset along its normal: of a plane or height field its own z axis, of a "
        "box the face that the robot meets, of others the mean direction of contact"
    )
    source = "Siciliano, Khatib, Springer Handbook of Robotics (2016), ch. 37: contact modeling"
    scope = "robot"
    parameters = (
        Parameter(
            "offset", "length", 0.0, -5.0, 5.0, (0.3, -0.3, 1.0, -1.0, 3.0), "clearance", step=0.02
        ),
    )
    confused_with: ClassVar = {
        "contact_stiffness": "press with two forces: a spring gives in proportion, an offset stays",
        "encoder_bias": _IN_THE_AIR,
        "base_tilt": _IN_THE_AIR,
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_offset = fields.contact_offset + values["offset"][:, 0]


class ContactStiffness(Effect):
    """The surfaces in contact are harder or softer."""

    id = "contact_stiffness"
    family = "contact"
    law = "k times 1 + relative_error; b as it was"
    source = "Todorov, ICRA (2014): convex and analytically-invertible dynamics with contacts"
    scope = "robot"
    parameters = (
        Parameter("relative_error", "one", 0.0, -0.95, 20.0, (0.5, -0.5, 3.0), step=0.05),
    )
    confused_with: ClassVar = {
        "contact_offset": "press with two forces: a spring gives in proportion, an offset stays",
        "contact_damping": "hold still against the surface: a damper has no part in it",
        "joint_elasticity": "load the joint without contact: a weight on the link",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_stiffness = fields.contact_stiffness + values["relative_error"][:, 0]


class ContactDamping(Effect):
    """The surfaces in contact take up more or less energy when they meet."""

    id = "contact_damping"
    family = "contact"
    law = "b times 1 + relative_error; k as it was (b also slows what slips within the cone)"
    source = "Hunt, Crossley, J. Appl. Mech. 42 (1975): restitution as damping in vibroimpact"
    scope = "robot"
    parameters = (
        Parameter("relative_error", "one", 0.0, -0.95, 10.0, (0.5, -0.5, 3.0), step=0.05),
    )
    confused_with: ClassVar = {
        "contact_stiffness": "hold still against the surface: a damper has no part in it",
        "viscous_friction": _IN_THE_AIR,
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_damping = fields.contact_damping + values["relative_error"][:, 0]


class ContactFriction(Effect):
    """What slides on a surface meets more or less friction."""

    id = "contact_friction"
    family = "contact"
    law = "|tangential force| <= (mu + coefficient) normal force; sliding only, mu at least 0"
    source = "Stewart, Trinkle, Int. J. Numer. Meth. Eng. 39 (1996): Coulomb friction in steps"
    scope = "robot"
    parameters = (Parameter("coefficient", "one", 0.0, -1.5, 2.0, (0.1, -0.1, 0.5), step=0.02),)
    confused_with: ClassVar = {
        "coulomb_friction": _IN_THE_AIR,
        "contact_damping": "slide at two speeds: friction does not heed them",
        "contact_offset": "slide both ways under one force: friction turns with the motion",
    }

    def fields(self, fields: ModelFields, values: Values) -> None:
        fields.contact_friction = fields.contact_friction + values["coefficient"][:, 0]
