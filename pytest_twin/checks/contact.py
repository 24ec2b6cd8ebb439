"""Contact primitives on a declared pair: approach, slide, release, grip, toss."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from pytest_twin.checks import contact_primitives, contact_toss, proposals
from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.contact_scene import FLOOR, OBJECT, SIZES, Scene
from pytest_twin.checks.fields import QUANTITY_SCHEMA
from pytest_twin.checks.poses import POSE_SCHEMA, keyframes_of
from pytest_twin.checks.scalars import declared_measure, scalar_measures
from pytest_twin.dependency import Structure
from pytest_twin.errors import TwinError
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
_MASS = 0.2  # kg, of the object in first specs
_LOAD = 1.962  # N, its weight; it is pressed as hard where it has none
_UNDEFINED = {
    "penetration": "no contact to the end",
    "normal_force": "no contact to the end",
    "friction": "the pair never slips",
    "slip_force": "the pair never slips",
    "rebound": "nothing came down on the pair",
    "restitution": "nothing came down on the pair",
    "slip": "the object is not held to the end",
}
_VECTOR: Mapping[str, Any] = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 3,
    "maxItems": 3,
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
        "target": {
            "type": "object",
            "properties": {
                "primitive": {"enum": ["approach", "slide", "release", "grip", "toss"]},
                "pair": {
                    "type": "array",
                    "items": {"type": "string", "minLength": 1},
                    "minItems": 2,
                    "maxItems": 2,
                    "uniqueItems": True,
                    "description": "Two geoms or bodies; 'object' and 'floor' are those declared "
                    "beside it. A grip names its two fingers.",
                },
                "object": {
                    "type": "object",
                    "description": "A free body to touch. It starts above the second of the pair, "
                    "or at a frame.",
                    "properties": {
                        "shape": {"enum": sorted(SIZES)},
                        "size": {
                            "type": "array",
                            "items": QUANTITY_SCHEMA,
                            "minItems": 1,
                            "maxItems": 3,
                            "description": "Half sizes in m: box x y z; sphere radius; cylinder "
                            "and capsule radius and half length along z.",
                        },
                        "mass": {**QUANTITY_SCHEMA, "description": "'0.1 kg'"},
                        "friction": {
                            "type": "number",
                            "minimum": 0,
                            "description": "Of its surface; without it, what it touches decides.",
                        },
                        "frame": {
                            "type": "string",
                            "minLength": 1,
                            "description": "Site or body at which it starts.",
                        },
                        "offset": {
                            **_VECTOR,
                            "description": "From there, in m: along the frame's axes, or the "
                            "world's where it starts above the second of the pair.",
                        },
                    },
                    "required": ["shape", "size", "mass"],
                    "additionalProperties": False,
                },
                **contact_toss.FIELDS,
                "floor": {
                    **QUANTITY_SCHEMA,
                    "description": "Height of a horizontal plane to touch, in the world.",
                },
            },
            "required": ["primitive", "pair"],
            "additionalProperties": False,
        },
        "stimulus": {
            "type": "object",
            "properties": {
                "duration": {
                    **QUANTITY_SCHEMA,
                    "description": "How long the pair touches; of a slide before, of a grip "
                    "before the object has weight.",
                },
                "pose": POSE_SCHEMA,
                "gravity": {"type": "boolean", "description": "True by default."},
                "others": {
                    "enum": ["free", "locked"],
                    "description": "locked: joints without command or effort are bolted.",
                },
                "gap": {
                    **QUANTITY_SCHEMA,
                    "description": "Between a free body and what it is put above, 10 mm by "
                    "default.",
                },
                "command": {
                    "type": "object",
                    "additionalProperties": {"type": "number"},
                    "description": "Actuator -> control that it goes to from its hold.",
                },
                "effort": {
                    "type": "object",
                    "additionalProperties": QUANTITY_SCHEMA,
                    "description": "Joint -> effort on it, N*m or N, beside any actuator.",
                },
                "press": {
                    **QUANTITY_SCHEMA,
                    "description": "Force on the first of the pair, towards the second: '5 N'.",
                },
                "ramp": {
                    **QUANTITY_SCHEMA,
                    "description": "How long commands, efforts and press take to grow, '0.2 s' by "
                    "default.",
                },
                "slide": {
                    "type": "object",
                    "description": "Of a slide: the force on the first of the pair.",
                    "properties": {
                        "direction": {**_VECTOR, "description": "In the world."},
                        "force": {**QUANTITY_SCHEMA, "description": "What it grows to: '10 N'."},
                        "duration": {**QUANTITY_SCHEMA, "description": "How long it grows."},
                        "travel": {
                            **QUANTITY_SCHEMA,
                            "description": "Way beyond which the pair has slipped, '1 mm' by "
                            "default.",
                        },
                    },
                    "required": ["direction", "force", "duration"],
                    "additionalProperties": False,
                },
                "hold": {
                    **QUANTITY_SCHEMA,
                    "description": "Of a grip: how long the object is held with its weight.",
                },
            },
            "additionalProperties": False,
        },
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
            | {f"{structure.realization}/keyframe:{name}" for name in keyframes_of(golden)}
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
                    measures.append(
                        Measure(
                            name, f"{pair} at onset", error, 0.0, error, bound.value, bound.unit
                        )
                    )
        friction = values.get("friction")
        measures += declared_measure(
            golden,
            "declared_friction",
            "1",
            float("nan") if friction is None else float(friction),
            pair if friction is not None else f"{pair}: {_UNDEFINED['friction']}",
            float(values["declared_friction"]),
        )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose specs that run on this robot.

        An object is released on and pushed over a fixed body, or a free robot is released above a
        floor, or a ball is pressed on the last link that it touches.
        """
        specs: list[Mapping[str, Any]] = []
        for choices in _proposals(realization):
            found = next((spec for spec in choices if self._rests(spec, realization)), None)
            if found is not None:
                specs.append(found)
        if not specs:
            raise NothingToProposeError(
                "no body of the robot is touched at its pose by a ball, a box or a floor"
            )
        return specs

    def _rests(self, spec: Mapping[str, Any], realization: Realization) -> bool:
        """Whether a spec brings the pair into contact and gives all numbers to compare."""
        trial = proposals.draft(self, realization, spec)
        try:
            values = self.observe(trial, realization, lambda _: None).values
        except TwinError:
            return False
        load = values["normal_force"]
        rests = load is not None and abs(load - _LOAD) < 0.02 * _LOAD
        return values["onset_time"] > 0.0 and (rests or "normal_force" not in spec["tolerance"])


def _proposals(realization: Realization) -> list[list[Mapping[str, Any]]]:
    """Return first specs, each as a list of variants at different positions."""
    from pytest_twin.realization import simulate

    structure = realization.structure
    given, colliding = realization.names("body"), structure.collision_bodies
    # The robot and its base are not a support for objects.
    robot = {b for body in structure.body_tree for b in structure.ancestors(body)}
    furniture = colliding.intersection(given) - robot
    named = [geom for geom, body in structure.geom_body.items() if body in furniture]
    standing = [*named, *sorted(furniture - {"world", *(structure.geom_body[g] for g in named)})]
    pose = {"pose": simulate.first_pose(realization)}
    box = {"shape": "box", "size": [0.02, 0.02, 0.02], "mass": f"{_MASS:g} kg"}
    rest = {"onset_time": "5 ms", "penetration": "0.1 mm", "normal_force": "0.1 N"}
    if standing:
        targets: list[dict[str, Any]] = [
            {"pair": [OBJECT, base], "object": {**box, "offset": [x, y, 0.0]}}
            for base in standing[:3]
            for x, y in ((0.0, 0.0), (0.3, 0.0), (0.0, 0.3), (-0.3, 0.0))
        ]
        release: list[Mapping[str, Any]] = [
            {
                "name": f"release_{target['pair'][1]}",
                "title": f"A box let go above {target['pair'][1]}",
                "target": {"primitive": "release", **target},
                "stimulus": {"duration": "1.5 s", "gap": "20 mm", "others": "locked", **pose},
                "tolerance": {**rest, "position": "1 mm", "rebound": "1 mm", "restitution": "5 %"},
            }
            for target in targets
        ]
        push = {"direction": [1.0, 0.0, 0.0], "force": f"{2.0 * _LOAD:.3g} N", "duration": "0.5 s"}
        slide: list[Mapping[str, Any]] = [
            {
                "name": f"slide_{target['pair'][1]}",
                "title": f"A box pushed over {target['pair'][1]}",
                "target": {"primitive": "slide", **target},
                "stimulus": {
                    "duration": "0.5 s", "gap": "1 mm", "slide": push, "others": "locked", **pose
                },
                "tolerance": {**rest, "friction": "2 %", "slip_force": "0.1 N"},
            }
            for target in targets
        ]  # fmt: skip
        return [release, slide]
    free = [joint for joint, kind in structure.joint_type.items() if kind == "free"]
    touching = [body for body in given if body in structure.body_tree.keys() & colliding]
    if free:
        return [
            [
                {
                    "name": f"release_{body}",
                    "title": f"The robot let go above a floor, {body} first",
                    "target": {"primitive": "release", "pair": [body, FLOOR], "floor": -5.0},
                    "stimulus": {"duration": "0.3 s", "gap": "20 mm", **pose},
                    "tolerance": {
                        "onset_time": "5 ms",
                        "position": "1 mm",
                        "orientation": "5 mrad",
                    },
                }
                for body in reversed(touching)
            ]
        ]
    ball = {"shape": "sphere", "size": [0.02], "mass": f"{_MASS:g} kg"}
    return [
        [
            {
                "name": f"approach_{body}",
                "title": f"A ball pressed on {body}",
                "target": {"primitive": "approach", "pair": [OBJECT, body], "object": ball},
                "stimulus": {
                    "duration": "0.3 s",
                    "gravity": False,
                    "press": f"{_LOAD:g} N",
                    "others": "locked",
                    **pose,
                },
                "tolerance": {"onset_time": "5 ms", "position": "1 mm"},
            }
            for body in reversed(touching)
        ]
    ]
