"""Settling: release the robot without motion commands, and check its rest position and energy."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.checks.base import Check, Measure, Observation, Progress, Trace
from pytest_twin.checks.fields import (
    CONTACT_SCHEMA,
    GRAVITY_SCHEMA,
    POSITION_UNIT,
    known_name,
    quantity,
    seconds,
    spec_error,
)
from pytest_twin.checks.poses import POSE_SCHEMA, REFERENCE, keyframe_parts, resolve_pose
from pytest_twin.checks.scalar_measures import declared_measure, sample_grid, scalar_measures
from pytest_twin.checks.schemas import array, choice, mapping, quantity_field, table, text
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.metrics.energy import energy_growth
from pytest_twin.metrics.pose import orientation_error, position_error, rotation_of
from pytest_twin.metrics.time_response import settling_time
from pytest_twin.twin import Simulator

if TYPE_CHECKING:
    from pytest_twin.realization import Realization
    from pytest_twin.realization.simulate import SimulatedMotion

SAMPLES = 101
"""Number of samples of a trace."""
_DEFAULT_BAND = {"rad": 1e-3, "m": 1e-4}
"""SI unit -> default of the distance to the rest position at which a joint counts as settled."""


class Settling(Check):
    """Free motion from a pose, without motion commands.

    ``values``: rest position: ``angle`` (hinge -> rad), ``position`` (slide -> m) and ``pose``
    (free joint -> position in m and quaternion w x y z, ball joint -> quaternion);
    ``settling_time`` in s or None; ``energy_growth``, ``energy_start`` and ``energy_end`` in J;
    ``penetration`` in m and the ``deepest`` pair.
    """

    kind: ClassVar[str] = "settling"
    dynamic: ClassVar[bool] = True
    simulators: ClassVar[tuple[Simulator, ...]] = ("mujoco", "newton")
    tolerances: ClassVar[Mapping[str, str]] = {
        "angle": "rad",
        "position": "m",
        "settling_time": "s",
        "energy_growth": "J",
        "penetration": "m",
    }
    schema: ClassVar[Mapping[str, Any]] = {
        "target": table(
            {
                "joints": array(
                    text(minLength=1),
                    "Joints whose rest position is compared. Default: all.",
                    minItems=1,
                    uniqueItems=True,
                )
            },
            "Joints to compare.",
        ),
        "stimulus": table(
            {
                "duration": quantity_field("Simulated time, such as '3 s'; up to 600 s."),
                "pose": POSE_SCHEMA,
                "displacement": mapping(
                    quantity_field(),
                    "Joint -> its displacement from the pose at the start, rad or m. Position "
                    "servos still command the pose.",
                ),
                "gravity": GRAVITY_SCHEMA,
                "contact": CONTACT_SCHEMA,
                "input": choice(
                    ["hold", "zero"],
                    "hold (default): position servos command the pose, velocity servos zero "
                    "velocity, motors zero effort. zero: all controls are 0, also those of "
                    "position servos.",
                ),
                "band": table(
                    {
                        "angle": quantity_field("For angles. Default: '1 mrad'."),
                        "position": quantity_field("For positions. Default: '0.1 mm'."),
                    },
                    "Largest distance from its rest position at which a joint counts as settled.",
                ),
            },
            required=["duration"],
        ),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all parts that affect motion, and the named keyframe."""
        return set(structure.dynamics()) | keyframe_parts(golden, structure)

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Release the robot and simulate for the duration."""
        from pytest_twin.realization import simulate

        stimulus = golden.stimulus
        structure = realization.structure
        wanted = golden.target.get("joints", realization.joints)
        for i, joint in enumerate(golden.target.get("joints", ())):
            known_name(golden, f"target.joints.{i}", joint, structure.joint_body, "joint")
        if not wanted:
            raise spec_error(
                golden,
                "target.joints",
                "the model has no named hinge or slide joint to watch",
                expected="at least one; give joints a name in the model",
            )
        duration = seconds(golden, "stimulus.duration", stimulus["duration"], most=600.0)
        pose = resolve_pose(golden, realization, stimulus.get("pose", REFERENCE), "stimulus.pose")
        model = simulate.prepare_model(
            realization,
            gravity=stimulus.get("gravity", True),
            contact=stimulus.get("contact", True),
        )
        data = simulate.initial_state(model, realization, pose.qpos)
        if stimulus.get("input", "hold") == "hold":
            data.ctrl[:] = simulate.hold(model, data)
        for joint, value in stimulus.get("displacement", {}).items():
            place = f"stimulus.displacement.{joint}"
            known_name(golden, place, joint, pose.joints, "hinge or slide joint")
            unit = POSITION_UNIT[structure.joint_type[joint]]
            data.qpos[realization.joint_qpos_index(joint)] += quantity(golden, place, value, unit)
        steps = simulate.steps_in(model, duration)
        run = simulate.run(realization, model, data, steps, progress=progress)
        bands = {
            unit: quantity(golden, f"stimulus.band.{name}", given, unit)
            for name, unit in (("angle", "rad"), ("position", "m"))
            for given in [stimulus.get("band", {}).get(name, _DEFAULT_BAND[unit])]
        }
        if min(bands.values()) <= 0.0:
            raise spec_error(
                golden,
                "stimulus.band",
                "a band of zero width",
                expected="more than zero, such as '5 mrad'",
            )
        final, excess, columns = _joints(realization, run, wanted, bands)
        growth = energy_growth(run.energy, run.actuator_work, run.constraint_work)
        grid = sample_grid(duration, SAMPLES)
        columns |= {
            "energy": ("J", run.energy),
            "actuator_work": ("J", run.actuator_work),
            "constraint_work": ("J", run.constraint_work),
            "penetration": ("m", run.penetration),
        }
        return Observation(
            values={
                **final,
                "settling_time": settling_time(
                    run.time, excess, np.zeros(excess.shape[1]), np.ones(excess.shape[1])
                ),
                "energy_growth": growth,
                "energy_start": float(run.energy[0]),
                "energy_end": float(run.energy[-1]),
                "penetration": float(run.penetration.max()),
                "deepest": None if run.deepest is None else list(run.deepest),
            },
            trace=Trace(
                axis=("time", "s"),
                x=grid,
                columns={
                    name: (unit, simulate.resample(run.time, values, grid))
                    for name, (unit, values) in columns.items()
                },
            ),
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare rest positions and settling time with the record, energy and depth with zero."""
        values = observation.values
        measures = []
        if golden.expected is not None:
            measures += _compare_rest(golden, values, golden.expected)
            measures += scalar_measures(
                golden,
                ["settling_time"],
                values,
                "robot",
                undefined={"settling_time": "it does not come to rest"},
            )
        measures += declared_measure(
            golden, "energy_growth", float(values["energy_growth"]), "robot"
        )
        pair = values["deepest"]
        measures += declared_measure(
            golden,
            "penetration",
            float(values["penetration"]),
            "no contact" if pair is None else " and ".join(pair),
        )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose settling under servos, after a displacement, or a fall, as the drives allow."""
        from pytest_twin.checks.settling_proposals import first_specs

        return first_specs(self, realization)


def _joints(
    realization: Realization,
    run: SimulatedMotion,
    wanted: Iterable[str],
    bands: Mapping[str, float],
) -> tuple[dict[str, Any], FloatArray, dict[str, tuple[str, FloatArray]]]:
    """Return final values, (n, k) distances to them in bands, and columns of the trace."""
    types = realization.structure.joint_type
    final: dict[str, Any] = {"angle": {}, "position": {}, "pose": {}}
    excess: list[FloatArray] = []
    columns: dict[str, tuple[str, FloatArray]] = {}
    for joint in wanted:
        at = realization.joint_qpos_index(joint)
        kind = types[joint]
        if kind in POSITION_UNIT:
            unit = POSITION_UNIT[kind]
            values = run.qpos[:, at]
            final["angle" if unit == "rad" else "position"][joint] = float(values[-1])
            excess.append((values - values[-1]) / bands[unit])
            columns[f"position:{joint}"] = (unit, values)
            continue
        if kind == "free":
            position = run.qpos[:, at : at + 3]
            excess.append(np.linalg.norm(position - position[-1], axis=1) / bands["m"])
            for axis, name in enumerate("xyz"):
                columns[f"{name}:{joint}"] = ("m", position[:, axis])
            at += 3
        quaternion = run.qpos[:, at : at + 4]
        cosine = np.abs(quaternion @ quaternion[-1]).clip(0.0, 1.0)
        excess.append(2.0 * np.arccos(cosine) / bands["rad"])
        start = at - 3 if kind == "free" else at
        final["pose"][joint] = run.qpos[-1, start : at + 4].tolist()
    return final, np.column_stack(excess), columns


def _compare_rest(golden: Golden, now: Mapping[str, Any], then: Mapping[str, Any]) -> list[Measure]:
    """Compare each joint's rest position with the record; NaN if only one has it."""
    measures = []
    for name in ("angle", "position"):
        bound = golden.tolerance.get(name)
        if bound is None:
            continue
        for joint in sorted({*now[name], *then.get(name, {})}):
            found, stored = (float(v.get(name, {}).get(joint, math.nan)) for v in (now, then))
            measures.append(Measure.of_difference(name, joint, (found, stored), bound))
    for joint in sorted({*now["pose"], *then.get("pose", {})}):
        errors = _pose_errors(now["pose"].get(joint, []), then.get("pose", {}).get(joint, []))
        for name, error in errors.items():
            bound = golden.tolerance.get(name)
            if bound is not None:
                measures.append(Measure.of_error(name, joint, error, bound))
    return measures


def _pose_errors(now: list[float], then: list[float]) -> dict[str, float]:
    """Return the distances of two poses in position, if they have one, and orientation."""
    if len(now) != len(then):
        return {"angle": math.nan}
    errors = {"angle": orientation_error(rotation_of(now[-4:]), rotation_of(then[-4:]))}
    if len(now) == 7:
        errors["position"] = position_error(now[:3], then[:3])
    return errors
