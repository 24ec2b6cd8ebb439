"""Step: response of one joint to a step of its command."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from pytest_twin.checks import proposals
from pytest_twin.checks.base import (
    Check,
    Measure,
    NothingToProposeError,
    Observation,
    Progress,
    Trace,
)
from pytest_twin.checks.drive import BENCH_SCHEMA, TARGET_SCHEMA, command_unit, prepare
from pytest_twin.checks.fields import POSITION_UNIT, quantity, seconds, spec_error
from pytest_twin.checks.poses import keyframe_parts
from pytest_twin.checks.scalar_measures import sample_grid, scalar_measures
from pytest_twin.checks.schemas import quantity_field, table
from pytest_twin.dependency import Structure
from pytest_twin.golden import Golden
from pytest_twin.metrics.time_response import step_metrics, worst_sample
from pytest_twin.twin import Simulator
from pytest_twin.words import list_names

if TYPE_CHECKING:
    from pytest_twin.realization import Realization

SAMPLES = 401
"""Largest number of samples of a trace."""
_METRICS = {"rise_time": "s", "overshoot": "1", "settling_time": "s", "steady_state_error": "1"}
_TRACE = {"rad": "angle", "m": "position", "rad/s": "angular_velocity", "m/s": "linear_velocity"}
_UNDEFINED = {
    "rise_time": "the response does not reach a steady state",
    "overshoot": "the response does not reach a steady state",
    "settling_time": "the response does not stay within 2 %",
    "steady_state_error": "no steady state, or a command of another quantity than the response",
}
_FIRST_BOUNDS = {
    "rise_time": "5 ms",
    "overshoot": "1 %",
    "settling_time": "20 ms",
    "steady_state_error": "1 %",
}
_STILL = 1e-9  # fraction of the step below which there is no response


class Step(Check):
    """Response to a step of one joint's command, after the robot has settled under its hold.

    ``values``: ``rise_time`` (10 to 90 %) and ``settling_time`` (2 %) in s, ``overshoot`` and
    ``steady_state_error`` as fractions of the step, each None if the response does not determine
    it, and ``final`` in the response's unit. The trace has command and response after the step.
    """

    kind: ClassVar[str] = "step"
    dynamic: ClassVar[bool] = True
    simulators: ClassVar[tuple[Simulator, ...]] = ("mujoco", "newton")
    tolerances: ClassVar[Mapping[str, str]] = {
        **_METRICS,
        **{name: unit for unit, name in _TRACE.items()},
    }
    schema: ClassVar[Mapping[str, Any]] = {
        "target": TARGET_SCHEMA,
        "stimulus": table(
            {
                "amplitude": quantity_field(
                    "Size of the step relative to the holding command, such as '5 deg' or '0.2 "
                    "N*m'. A number without a unit is in rad, m, rad/s, m/s, N*m or N."
                ),
                "duration": quantity_field("Time after the step, such as '1 s'."),
                **BENCH_SCHEMA,
            },
            required=["amplitude", "duration"],
        ),
    }

    def depends(self, golden: Golden, structure: Structure) -> Iterable[str]:
        """Return all parts that affect the joint's motion, and the named keyframe."""
        return set(structure.dynamics([golden.target["joint"]])) | keyframe_parts(golden, structure)

    def observe(self, golden: Golden, realization: Realization, progress: Progress) -> Observation:
        """Hold the joint, let it settle, and apply the step."""
        from pytest_twin.realization import simulate

        unit = command_unit(golden, realization)
        amplitude = quantity(golden, "stimulus.amplitude", golden.stimulus["amplitude"], unit)
        if amplitude == 0.0:
            raise spec_error(
                golden,
                "stimulus.amplitude",
                "the amplitude is zero",
                value=0,
                unit=unit,
                expected=f"a step other than 0 {unit}",
            )
        duration = seconds(golden, "stimulus.duration", golden.stimulus["duration"])
        drive = prepare(golden, realization, (min(0.0, amplitude), max(0.0, amplitude)))
        fitting = _TRACE[drive.response_unit]
        for name in set(golden.tolerance) & set(_TRACE.values()) - {fitting}:
            raise spec_error(
                golden,
                f"tolerance.{name}",
                f"joint {drive.joint!r} responds in {drive.response_unit}",
                expected=f"tolerance.{fitting}",
            )
        drive.apply(drive.hold + amplitude)
        steps = simulate.steps_in(drive.model, duration)
        run = simulate.run(realization, drive.model, drive.data, steps, progress=progress)
        time = run.time - run.time[0]
        response = drive.series(run.qpos, run.qvel)
        same = drive.command == drive.response
        metrics = step_metrics(
            time,
            response,
            target=drive.hold + amplitude if same else None,
            smallest=_STILL * abs(amplitude),
        )
        grid = sample_grid(duration, min(SAMPLES, steps + 1))
        command = np.full(grid.size, drive.hold + amplitude)
        return Observation(
            values=asdict(metrics),
            trace=Trace(
                axis=("time", "s"),
                x=grid,
                columns={
                    f"command:{drive.joint}": (drive.command_unit, command),
                    f"{drive.response}:{drive.joint}": (
                        drive.response_unit,
                        simulate.resample(time, response, grid),
                    ),
                },
            ),
        )

    def compare(
        self, golden: Golden, observation: Observation, stored: Trace | None
    ) -> list[Measure]:
        """Compare metrics and the worst sample of the response with the record."""
        joint = golden.target["joint"]
        measures = scalar_measures(
            golden, _METRICS, observation.values, joint, undefined=_UNDEFINED
        )
        if stored is None or observation.trace is None:
            return measures
        for column, (unit, now) in observation.trace.columns.items():
            bound = golden.tolerance.get(_TRACE.get(unit, ""))
            if column.startswith("command:") or bound is None:
                continue
            there = column in stored.columns
            then = stored.columns[column][1] if there else np.full(stored.x.size, np.nan)
            error, time, found, expected = worst_sample(
                stored.x,
                np.interp(stored.x, observation.trace.x, now),
                then,
            )
            measures.append(
                Measure(
                    name=_TRACE[unit],
                    subject=joint if there else f"{joint}: the golden's trace has no {column!r}",
                    measured=found,
                    golden=expected,
                    error=error,
                    tolerance=bound.value,
                    unit=unit,
                    time=time,
                )
            )
        return measures

    def first(self, realization: Realization) -> list[Mapping[str, Any]]:
        """Propose a small step of every drive, or a torque step of every joint without drives."""
        proposals.require_mass(realization)
        actuation = proposals.Actuation.of(realization)
        specs = [
            self._joint_step(realization, joint, command, actuation)
            for joint, command in proposals.drivable(realization)
        ]
        specs += self._tendon_steps(realization)
        if not specs:
            raise NothingToProposeError("no joint takes a command")
        return specs

    def _joint_step(
        self,
        realization: Realization,
        joint: str,
        command: str,
        actuation: proposals.Actuation,
    ) -> Mapping[str, Any]:
        duration = 1.0 if command == "position" else 0.5
        bench = proposals.first_bench(realization, command)
        quantity_name = {"position": "position command", "velocity": "velocity command"}.get(
            command, "torque" if _is_hinge(realization, joint) else "force"
        )
        alone = " with the other joints locked, without gravity" if "others" in bench else ""
        spec: dict[str, Any] = {
            "name": joint,
            "title": f"Step of the {quantity_name} of {joint}{alone}",
            "target": {"joint": joint, "command": command},
            "stimulus": {
                "amplitude": proposals.first_amplitude(realization, joint, command, duration),
                "duration": f"{duration:g} s",
                **bench,
            },
        }
        fraction, notes = proposals.MOTION_FRACTION, []
        if command == "effort":
            fraction, light = proposals.torque_fraction(realization, joint)
            if told := actuation.no_controller(realization):
                notes.append(told)
            if light:
                notes.append(
                    f"Not tested by this step: the mass of {list_names(light, 6)} (less "
                    "than 0.4 % of the inertia about the joint). mass_properties tests it."
                )
        return self._bounded(realization, spec, fraction, notes)

    def _tendon_steps(self, realization: Realization) -> list[Mapping[str, Any]]:
        specs = []
        for actuator, joint in proposals.tendon_drives(realization):
            amplitude = proposals.tendon_amplitude(realization, actuator)
            if amplitude is None:
                continue
            bench = proposals.first_bench(realization, "position")
            spec = {
                "name": actuator,
                "title": f"Step of {actuator}, which drives {joint} through a tendon",
                "target": {"joint": joint, "actuator": actuator},
                "stimulus": {"amplitude": amplitude, "duration": "1 s", **bench},
            }
            specs.append(self._bounded(realization, spec, proposals.MOTION_FRACTION, []))
        return specs

    def _bounded(
        self,
        realization: Realization,
        spec: dict[str, Any],
        fraction: float,
        notes: list[str],
    ) -> Mapping[str, Any]:
        """Add tolerances for the values of the spec's response."""
        trial = proposals.draft(self, realization, spec)
        found = self.observe(trial, realization, lambda _: None)
        assert found.trace is not None
        unit, response = next(
            column for name, column in found.trace.columns.items() if name[:8] != "command:"
        )
        tolerance = {
            name: bound for name, bound in _FIRST_BOUNDS.items() if found.values[name] is not None
        }
        motion = float(np.ptp(response))
        tolerance[_TRACE[unit]] = proposals.fraction_of(motion, unit, fraction)
        notes = [
            f"Tolerance of {_TRACE[unit]}: {100.0 * fraction:.2g} % of the motion, "
            f"{motion:.3g} {unit}.",
            *notes,
        ]
        return {**spec, "tolerance": tolerance, "notes": notes}


def _is_hinge(realization: Realization, joint: str) -> bool:
    return POSITION_UNIT[realization.structure.joint_type[joint]] == "rad"
