"""Contact primitives on a declared pair: approach, slide, release, grip, toss."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.checks import contact_primitives, contact_proposals, contact_toss
from pytest_twin.checks.base import Check, Measure, Observation, Progress, Trace
from pytest_twin.checks.contact_scene import FLOOR, OBJECT, SIZES, Scene
from pytest_twin.checks.fields import GRAVITY_SCHEMA
from pytest_twin.checks.poses import POSE_SCHEMA, keyframe_parts
from pytest_twin.checks.scalar_measures import declared_measure, scalar_measures
from pytest_twin.checks.schemas import array, choice, mapping, number, quantity_field, table, text
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.metrics.pose import orientation_error, position_error, rotation_of

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_SCALARS = {
    "onset_time": "s",
    "penetration": "m",
    "normal_force": "N",
    "friction": "1",
    "slip_force": "N",
    "rebound": "m",
    "restitution": "1",
    "slip": "m",
    "opening": "m",
}
_UNDEFINED = {
    "penetration": "no contact to the end",
    "normal_force": "no contact to the end",
    "friction": "the pair never slips",
    "slip_force": "the pair never slips",
    "rebound": "nothing came down on the pair",
    "restitution": "nothing came down on the pair",
    "slip": "the object is not held to the end",
}


class Contact(Check):
    """A declared pair that a primitive brings into contact.

    - ``approach``: the first of the pair moves to the second, by commands, efforts or a force.
    - ``slide``: as ``approach``, then a tangential force grows until the pair slips.
    - ``release``: a free body is released above the second of the pair.
    - ``grip``: the pair closes on an object, which has no weight until the grip is closed.
    - ``toss``: the first of the pair starts in its recorded state and is compared with its
    recorded poses; ``values`` are those of :mod:`contact_toss`.

    ``values``, each None if the contact does not determine it: ``onset_time`` in s and ``onset``,
    the pose of the first body in the world at first contact (m, quaternion w x y z);
    ``penetration`` in m and ``normal_force`` in N at rest (of the weaker finger in a grip);
    ``friction`` and ``slip_force`` in N; ``rebound`` in m and ``restitution``; ``slip`` in m
    (along the surface, or of the object in the grip) and ``opening`` of the grip in m;
    ``declared_friction`` of the contact.
    """

    kind: ClassVar[str] = "contact"
    tolerances: ClassVar[Mapping[str, str]] = {
        **_SCALARS,
        "position": "m",
        "orientation": "rad",
        "declared_friction": "1",
        **contact_toss.UNITS,
    }
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "primitive": choice(
                    ["approach", "slide", "release", "grip", "toss"],
                    "How the pair is brought into contact.",
                ),
                "pair": array(
                    text(minLength=1),
                    "Two geoms or bodies. 'object' and 'floor' are those that the target adds to "
                    "the scene. For grip: the two fingers.",
                    count=2,
                    uniqueItems=True,
                ),
                "object": table(
                    {
                        "shape": choice(sorted(SIZES), "Shape of the object."),
                        "size": array(
                            quantity_field(),
                            "Half sizes in m. Box: along x, y and z. Sphere: radius. Cylinder and "
                            "capsule: radius, and half length along z.",
                            minItems=1,
                            maxItems=3,
                        ),
                        "mass": quantity_field("Mass, such as '0.1 kg'."),
                        "friction": number(
                            "Coefficient of sliding friction. Default: all contact parameters are "
                            "those of the body that the object touches.",
                            minimum=0,
                        ),
                        "frame": text("Site or body at which the object starts.", minLength=1),
                        "offset": array(
                            number(),
                            "Displacement of the start, m, along the axes of "
                            "frame, or of the world without frame. Default: zero.",
                            count=3,
                        ),
                    },
                    "Free body that is added to the scene. It starts above the second of the "
                    "pair, or at a frame.",
                    required=["shape", "size", "mass"],
                ),
                **contact_toss.FIELDS,
                "floor": quantity_field(
                    "Height of a horizontal plane that is added to the scene, m in the world frame."
                ),
            },
            required=["primitive", "pair"],
        ),
        "stimulus": table(
            {
                "duration": quantity_field(
                    "Simulated time, up to 60 s. For slide: the time before the tangential force. "
                    "For grip: the time before the object has weight."
                ),
                "pose": POSE_SCHEMA,
                "gravity": GRAVITY_SCHEMA,
                "others": choice(
                    ["free", "locked"],
                    "free (default): all joints can move. locked: joints without a command or "
                    "effort are fixed.",
                ),
                "gap": quantity_field(
                    "Distance at the start between a free body and the body below it. Default: "
                    "'10 mm'."
                ),
                "command": mapping(
                    number(),
                    "Actuator -> value to which its control changes from the holding command.",
                ),
                "effort": mapping(
                    quantity_field(), "Joint -> effort in N*m or N, added to that of actuators."
                ),
                "press": quantity_field(
                    "Force on the first of the pair towards the second, such as '5 N'. Default: "
                    "none."
                ),
                "ramp": quantity_field(
                    "Time in which command, effort and press grow to their values. Default: '0.2 "
                    "s'."
                ),
                "slide": table(
                    {
                        "direction": array(
                            number(),
                            "Direction in the world frame. Only its part along the "
                            "surface is used.",
                            count=3,
                        ),
                        "force": quantity_field("Final value, such as '10 N'."),
                        "duration": quantity_field(
                            "Time in which the force grows from zero, up to 60 s."
                        ),
                        "travel": quantity_field(
                            "Displacement above which the pair has slipped. Default: '1 mm'."
                        ),
                    },
                    "For slide: tangential force on the first of the pair.",
                    required=["direction", "force", "duration"],
                ),
                "hold": quantity_field(
                    "For grip: time for which the object is held with its weight, up to 60 s."
                ),
            }
        ),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all moving parts, all parts that can be touched, and the named keyframe."""
        target = golden.target
        own = {name for name in (OBJECT, FLOOR) if name in target}
        return (
            set(structure.dynamics())
            | set(structure.contact())
            | structure.additions()
            | set(structure.contact(set(target["pair"]) - own))
            | keyframe_parts(golden, structure)
            | ({f"recording:{target['recording']}"} if "recording" in target else set())
        )

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Build the scene, run the primitive, and measure the pair's contacts."""
        if golden.target["primitive"] == contact_toss.TOSS:
            return contact_toss.observe(golden, realization, progress)
        act = contact_primitives.PRIMITIVES[golden.target["primitive"]]
        return act(golden, Scene(golden, realization), progress)

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare numbers and onset pose with the record, friction with the model's coefficient."""
        values = observation.values
        if golden.target["primitive"] == contact_toss.TOSS:
            return contact_toss.measures(golden, values)
        pair = " on ".join(golden.target["pair"])
        measures = scalar_measures(golden, _SCALARS, values, pair, undefined=_UNDEFINED)
        if golden.expected is not None and "onset" in golden.expected:
            now, then = values["onset"], golden.expected["onset"]
            errors = {
                "position": position_error(now[:3], then[:3]),
                "orientation": orientation_error(rotation_of(now[3:]), rotation_of(then[3:])),
            }
            for name, error in errors.items():
                bound = golden.tolerance.get(name)
                if bound is not None:
                    measures.append(Measure.of_error(name, f"{pair} at onset", error, bound))
        friction = values.get("friction")
        measures += declared_measure(
            golden,
            "declared_friction",
            float("nan") if friction is None else float(friction),
            pair if friction is not None else f"{pair}: {_UNDEFINED['friction']}",
            float(values["declared_friction"]),
        )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose specs that run on this robot: see :mod:`contact_proposals`."""
        return contact_proposals.first_specs(self, realization)
