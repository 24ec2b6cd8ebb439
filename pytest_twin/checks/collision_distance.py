"""Distances of declared pairs by MuJoCo and coal, and reasons for disabled pairs."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.fields import known_name, spec_error, tolerance
from pytest_twin.checks.poses import (
    POSES_SCHEMA,
    REFERENCE,
    joints_above,
    keyframe_parts,
    recorded_poses,
    resolve_poses,
)
from pytest_twin.checks.schemas import array, table, text
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.units import Quantity

if TYPE_CHECKING:
    import mujoco

    from pytest_twin.realization import Realization
    from pytest_twin.realization.collision import Shapes

_NAN = float("nan")
_FIRST_PAIRS = 12  # pairs of a first spec
_NAMES_SCHEMA: Mapping[str, Any] = array(text(minLength=1), minItems=2, uniqueItems=True)


class CollisionDistance(Check):
    """Signed distance of pairs of bodies or geoms: positive if apart, else minus the overlap.

    MuJoCo's distance is compared with the record and with coal's distance of the same shapes at
    the same poses. Coal uses primitives unchanged and computes the convex hull of mesh vertices
    itself. The distance of two bodies is the smallest distance of their colliding geoms.

    A pair of bodies is disabled if an ``exclude`` element or the collision masks prevent contact
    of geoms that could otherwise touch. A body and its parent, which MuJoCo never lets collide,
    are not included. Each disabled pair needs an entry under ``disabled`` with the reason.

    ``values``: ``poses`` (drawn poses), ``distance``: pair ``a - b`` -> pose -> m, ``disabled``:
    pair -> element that disables it.
    """

    kind: ClassVar[str] = "collision_distance"
    libraries: ClassVar[tuple[str, ...]] = ("numpy", "scipy", "coal")
    tolerances: ClassVar[Mapping[str, str]] = {"distance": "m", "penetration": "m"}
    required_tolerances: ClassVar[frozenset[str]] = frozenset({"distance"})
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "pairs": array(
                    {**_NAMES_SCHEMA, "maxItems": 2},
                    "Pairs of bodies or geoms between which the distance is compared. Where a body "
                    "and a geom have the same name, it is the geom.",
                ),
                "disabled": array(
                    table(
                        {
                            "pair": {
                                **_NAMES_SCHEMA,
                                "maxItems": 2,
                                "description": "The two bodies.",
                            },
                            "among": {
                                **_NAMES_SCHEMA,
                                "description": "Bodies; the reason holds for each pair of them.",
                            },
                            "reason": text(
                                "Why these bodies may pass through each other.", pattern="\\S"
                            ),
                        },
                        required=["reason"],
                        oneOf=[{"required": ["pair"]}, {"required": ["among"]}],
                    ),
                    "All pairs of bodies whose collision the model disables, with the reasons.",
                ),
            },
            required=["pairs", "disabled"],
        ),
        "stimulus": table({"poses": POSES_SCHEMA}, required=["poses"]),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return shapes and chains of the pairs, masks of all bodies, and the disabled pairs."""
        names = {name for pair in golden.target["pairs"] for name in pair}
        masks = {
            part
            for part in structure.part_ids
            if part.startswith(f"{structure.realization}/collision:")
        }
        return structure.contact(names).union(
            masks,
            {f"{structure.realization}/contact:pairs"},
            keyframe_parts(golden, structure),
        )

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Compute distances at every pose with MuJoCo and coal, and find the disabled pairs."""
        import mujoco

        from pytest_twin.realization import collision

        shapes = collision.Shapes(realization)
        pairs = []
        for i, pair in enumerate(golden.target["pairs"]):
            place = f"target.pairs.{i}"
            sides = []
            for name in pair:
                known_name(golden, place, name, shapes.names, "geom or collision body")
                sides.append(shapes.geoms(name))
            if sides[0] & sides[1]:
                raise spec_error(
                    golden,
                    place,
                    "a pair of a body with itself",
                    value=pair,
                    expected="two different bodies",
                )
            pairs.append((f"{pair[0]} - {pair[1]}", sides[0], sides[1]))
        for i, entry in enumerate(golden.target["disabled"]):
            for name in entry.get("pair", entry.get("among", ())):
                known_name(golden, f"target.disabled.{i}", name, shapes.bodies, "body")
        structure = realization.structure
        bodies = _bodies(golden, structure)
        poses = resolve_poses(golden, realization, moved=joints_above(structure, bodies))
        data = mujoco.MjData(realization.model)
        found: dict[str, dict[str, float]] = {name: {} for name, _, _ in pairs}
        reference: dict[str, dict[str, float]] = {name: {} for name, _, _ in pairs}
        for number, pose in enumerate(poses):
            data.qpos[:] = pose.qpos
            mujoco.mj_kinematics(realization.model, data)
            for name, first, second in pairs:
                found[name][pose.name] = shapes.distance(data, first, second)
                reference[name][pose.name] = shapes.distance_by_coal(data, first, second)
            progress((number + 1) / len(poses))
        disabled = {f"{a} - {b}": why for (a, b), why in collision.disabled_pairs(realization)}
        return Observation(
            {"poses": recorded_poses(poses), "distance": found, "disabled": disabled},
            reference={"distance": reference},
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare each pair's worst pose; report disabled pairs without a reason."""
        measures = []
        sources = [("coal", observation.reference["distance"])]
        if golden.expected is not None:
            sources.insert(0, ("golden", golden.expected.get("distance", {})))
        for pair, found in observation.values["distance"].items():
            for against, expected in sources:
                candidates = [
                    self._measure(
                        golden, pair, pose, value, expected.get(pair, {}).get(pose, _NAN), against
                    )
                    for pose, value in found.items()
                ]
                measures.append(max(candidates, key=_use))
        measures.extend(_reasons(golden, observation.values["disabled"]))
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose the closest pairs of bodies that can collide, and all disabled pairs."""
        import mujoco

        from pytest_twin.realization import collision

        shapes = collision.Shapes(realization)
        data = mujoco.MjData(realization.model)
        mujoco.mj_kinematics(realization.model, data)
        disabled = collision.disabled_pairs(realization)
        pairs = []
        for a, b in collision.enabled_pairs(realization):
            distance = shapes.measurable_distance(data, a, b)
            if distance is not None:
                pairs.append((distance, a, b))
        apart = [[a, b] for distance, a, b in sorted(pairs) if distance > 0.0][:_FIRST_PAIRS]
        if not apart and not disabled:
            raise NothingToProposeError("no two bodies of the robot have shapes that can collide")
        entries: list[dict[str, Any]] = [
            {"pair": list(pair), "reason": _first_reason(shapes, data, pair, why)}
            for pair, why in disabled
        ]
        if not collision.enabled_pairs(realization) and len(disabled) > 1:
            whole = sorted({name for pair, _ in disabled for name in pair})
            entries = [{"among": whole, "reason": f"{disabled[0][1]} in the supplier's model"}]
        return [
            {
                "name": "collision_distance",
                "title": "Distances of the pairs that come closest, and every disabled pair",
                "target": {
                    "pairs": apart,
                    "disabled": entries,
                },
                "stimulus": {"poses": [REFERENCE]},
                "tolerance": {"distance": "10 um", "penetration": "0.5 mm"},
            }
        ]

    def _measure(
        self,
        golden: Golden,
        pair: str,
        pose: str,
        measured: float,
        expected: float,
        against: str,
    ) -> Measure:
        overlap = measured < 0.0 or expected < 0.0
        name = "penetration" if overlap and "penetration" in golden.tolerance else "distance"
        bound = tolerance(golden, name, "every collision_distance golden bounds it")
        return Measure.of_difference(
            name, f"{pair} at {pose}", (measured, expected), bound, against
        )


def _bodies(golden: Golden, structure: Structure) -> set[str]:
    """Return the bodies of the declared pairs."""
    return {structure.geom_body.get(name, name) for pair in golden.target["pairs"] for name in pair}


def _use(measure: Measure) -> float:
    """Return error divided by tolerance, as a sort key that puts NaN first."""
    if np.isnan(measure.error):
        return float("inf")
    return measure.error / max(measure.tolerance, 1e-300)


def _reasons(golden: Golden, disabled: Mapping[str, str]) -> list[Measure]:
    """Return a measure for each disabled pair without a reason, and each reason without a pair."""
    declared: set[frozenset[str]] = set()
    for entry in golden.target["disabled"]:
        if "pair" in entry:
            declared.add(frozenset(entry["pair"]))
        else:
            declared.update(frozenset(pair) for pair in itertools.combinations(entry["among"], 2))
    found = {frozenset(pair.split(" - ")): (pair, why) for pair, why in disabled.items()}
    faults = [
        (f"{pair}: {why}, and target.disabled gives no reason", (1.0, 0.0))
        for key, (pair, why) in found.items()
        if key not in declared
    ]
    faults += [
        (f"{' - '.join(entry['pair'])}: declared as disabled, but can collide", (0.0, 1.0))
        for entry in golden.target["disabled"]
        if "pair" in entry and frozenset(entry["pair"]) not in found
    ]
    if not faults:
        faults = [("every disabled pair has its reason", (0.0, 0.0))]
    return [
        Measure.of_difference("disabled", subject, values, Quantity(0.0, "1"), "declared")
        for subject, values in faults
    ]


def _first_reason(shapes: Shapes, data: mujoco.MjData, pair: tuple[str, str], why: str) -> str:
    distance = shapes.measurable_distance(data, *pair)
    if distance is None:
        return f"{why} in the supplier's model"
    if distance < 0.0:
        return f"{why}; they overlap by {-1e3 * distance:.2g} mm at the reference pose"
    return f"{why} in the supplier's model; {1e3 * distance:.3g} mm apart at the reference pose"
