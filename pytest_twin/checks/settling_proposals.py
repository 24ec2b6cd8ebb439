"""Propose specs of kind ``settling`` that fit the robot's drives, base and floor."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pytest_twin.checks import proposals
from pytest_twin.checks.base import Check, NothingToProposeError
from pytest_twin.checks.fields import POSITION_UNIT
from pytest_twin.words import list_names

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

_STILL = 1e-6  # rad or m: a motion below this in 0.3 s is not a fall; also the smallest tolerance
_ON_FLOOR = {"angle": "5 mrad", "position": "1 mm", "settling_time": "50 ms"}


def first_specs(check: Check, realization: Realization) -> list[Mapping[str, Any]]:
    """Return first specs of kind ``settling``.

    Raises:
        NothingToProposeError: the robot has none; the error has the reason.
    """
    if not realization.joints:
        jointed = realization.model.njnt > 0
        raise NothingToProposeError("no joint has a name" if jointed else "the robot has no joints")
    proposals.require_mass(realization)
    actuation = proposals.Actuation.of(realization)
    bench: dict[str, Any] = {"pose": proposals.first_pose(realization)}
    notes: list[str] = []
    if _overlaps(realization):
        bench["contact"] = False
    notes += filter(None, (actuation.no_controller(realization), proposals.fixed_base(realization)))
    specs = []
    reasons = []
    for propose in (_under_gravity, _return_from_displacement):
        try:
            specs.append(propose(check, realization, actuation, bench))
        except NothingToProposeError as error:
            reasons.append(str(error))
    if not specs:
        raise NothingToProposeError("; ".join(reasons))
    notes += [f"Left out: {reason}." for reason in reasons]
    return [
        {
            **{field: spec[field] for field in ("name", "title", "target", "stimulus")},
            "tolerance": spec["tolerance"],
            "notes": [*spec.get("notes", []), *_without_contact(spec), *notes],
        }
        for spec in specs
    ]


def _without_contact(spec: Mapping[str, Any]) -> list[str]:
    if spec["stimulus"].get("contact", True):
        return []
    return ["Contacts are switched off, because bodies overlap at the pose."]


def _under_gravity(
    check: Check,
    realization: Realization,
    actuation: proposals.Actuation,
    bench: Mapping[str, Any],
) -> dict[str, Any]:
    """Propose servos against gravity, a free base on its floor, or a fall of unheld joints."""
    stimulus: dict[str, Any] = {**bench, "gravity": True}
    spec: dict[str, Any] = {"name": "gravity", "target": {}}
    if actuation.floating:
        spec["title"] = "Come to rest on the floor under gravity"
        if actuation.held:
            spec["title"] += ", servos holding the joints"
        # Feet that touch the floor at the pose do not count as overlap.
        stimulus.pop("contact", None)
        spec["stimulus"] = {"duration": "3 s", **stimulus}
        found = _observed_values(check, spec, realization)
        if found["deepest"] is None:
            raise NothingToProposeError(
                "settling under gravity, because the base floats and nothing is under it (a "
                "contact golden can drop it on a floor)"
            )
        if found["settling_time"] is None:
            raise NothingToProposeError(
                "settling under gravity, because the base floats and does not come to rest on "
                "its floor within 3 s"
            )
        return {**spec, "tolerance": _bounds(found) | _ON_FLOOR}
    if not actuation.held:
        spec["title"] = "Fall from the pose under gravity; nothing holds the joints"
        spec["stimulus"] = {"duration": "0.3 s", **stimulus}
        found = _observed_values(check, spec, realization)
        moved = _motion(found, realization)
        if not any(motion > _STILL for motion in moved.values()):
            raise NothingToProposeError("a fall under gravity, because gravity moves no joint")
        return {**spec, "tolerance": _bounds(found, moved)}
    if actuation.loose:
        spec["title"] = (
            f"{len(actuation.held)} joints held by servos under gravity, the rest swinging"
        )
        spec["notes"] = [
            f"No position servo holds {list_names(actuation.loose, 6)}: simulated for 0.3 s "
            "only, because a swinging motion amplifies rounding errors."
        ]
    else:
        spec["title"] = "Servos hold the pose under gravity"
    spec["stimulus"] = {"duration": "0.3 s" if actuation.loose else "3 s", **stimulus}
    return {**spec, "tolerance": _bounds(_observed_values(check, spec, realization))}


def _return_from_displacement(
    check: Check,
    realization: Realization,
    actuation: proposals.Actuation,
    bench: Mapping[str, Any],
) -> dict[str, Any]:
    """Propose servos that return displaced joints, without gravity."""
    types = realization.structure.joint_type
    displaced = {
        joint: 0.05 if types[joint] == "hinge" else 0.002
        for joint in sorted(actuation.held)
        if types[joint] in POSITION_UNIT
    }
    if not displaced:
        raise NothingToProposeError(
            "motion without gravity, because no servo would move the joints"
        )
    base = "; the base floats" if actuation.floating else ""
    loose = actuation.loose or actuation.floating
    spec = {
        "name": "no_gravity",
        "title": f"Servos return the joints to the pose, without gravity{base}",
        "target": {},
        "stimulus": {
            "duration": "0.3 s" if loose else "3 s",
            **bench,
            "gravity": False,
            "displacement": displaced,
        },
    }
    return {**spec, "tolerance": _bounds(_observed_values(check, spec, realization))}


def _observed_values(
    check: Check, spec: Mapping[str, Any], realization: Realization
) -> Mapping[str, Any]:
    trial = proposals.draft(check, realization, spec)
    return check.observe(trial, realization, lambda _: None).values


def _bounds(found: Mapping[str, Any], motion: Mapping[str, float] | None = None) -> dict[str, str]:
    """Return tolerances of a first spec; those against zero exceed the present values.

    Args:
        found: values of a trial run.
        motion: unit -> fall of the joints; tolerances of the rest position are a fraction of it.
    """
    growth = max(1e-3, 2.0 * found["energy_growth"])
    depth = max(1e-4, 2.0 * found["penetration"])
    bounds = {"angle": "1 mrad", "position": "0.1 mm"}
    if motion:
        bounds = {
            name: proposals.fraction_of(motion[unit], unit, least=_STILL)
            for name, unit in (("angle", "rad"), ("position", "m"))
            if motion[unit] > _STILL
        }
    if found["settling_time"] is not None:
        bounds["settling_time"] = "20 ms"
    return {
        **bounds,
        "energy_growth": f"{growth:.2g} J",
        "penetration": f"{depth * 1e3:.2g} mm",
    }


def _motion(found: Mapping[str, Any], realization: Realization) -> dict[str, float]:
    """Return unit -> largest distance of the joints from their start, rad and m."""
    start = proposals.first_qpos(realization)
    return {
        unit: max(
            (
                abs(value - float(start[realization.joint_qpos_index(joint)]))
                for joint, value in found[name].items()
            ),
            default=0.0,
        )
        for name, unit in (("angle", "rad"), ("position", "m"))
    }


def _overlaps(realization: Realization) -> bool:
    from pytest_twin.realization import simulate

    return simulate.overlaps(realization, proposals.first_qpos(realization))
