"""Drives written as the configurations of actuators that a simulator takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import mujoco
from lxml import etree

from pytest_twin.diagnosis.patched.model import MODEL_FILE
from pytest_twin.effects import catalogue
from pytest_twin.errors import SpecError
from pytest_twin.export import foreign_engine, measure
from pytest_twin.export.drive_table import (
    DriveRow,
    DriveTable,
    drive_table,
    expressions,
    rounding_note,
)
from pytest_twin.export.expression import Expression
from pytest_twin.export.integration import Integration
from pytest_twin.export.mujoco_target import (
    copy_assets,
    effect_row,
    integration_row,
    joint_errors,
    measured_row,
)
from pytest_twin.export.source import ExportSource
from pytest_twin.export.target import Exported
from pytest_twin.formats import atomic
from pytest_twin.realization import mjcf_file
from pytest_twin.trial import Trial

_DIVISORS = (1, 4, 16, 32)
"""Numbers of the simulator's steps in one step of the model that are tried in this order."""
_MOTOR_ATTRIBUTES = ("name", "joint", "ctrlrange", "forcerange", "ctrllimited", "forcelimited")


@dataclass(frozen=True, slots=True)
class ConfigTarget:
    """A simulator whose actuators are configurations.

    Attributes:
        file: name of the file with the drives.
        engine: package and version whose fields are written.
        render: drives and time step of the model in s -> text of the file.
        written: part of a drive -> field that holds it.
        approximated: part of a drive -> what is missing.
        modes: command modes that the configurations take.
        actuators: whether the robot's file keeps its actuators, has none, or has motors.
        stepper: script that steps the export in its own simulator; empty if there is none.
    """

    file: str
    engine: str
    render: Callable[[Sequence[DriveRow], float], str]
    written: Mapping[str, str]
    approximated: Mapping[str, str]
    modes: tuple[str, ...]
    actuators: Literal["kept", "none", "motors"]
    stepper: str = ""


def export_config(target: ConfigTarget, source: ExportSource, folder: Path) -> Exported:
    """Write the drives and the robot's file into an empty folder.

    With ``source.engine``, the export is stepped there, and written for the coarsest of the time
    steps with which it is within the tolerance.

    Raises:
        TwinError: the model has a contact effect, or files that cannot be written; or the
            recordings cannot be replayed in the target's simulator.
    """
    realization = source.loaded.realization
    table = drive_table(realization, source.patched)
    rows = [row for row in table.rows if row.mode in target.modes]
    trials: tuple[Trial, ...] = ()
    if source.engine is not None:
        trials = measure.chosen_trials(source.held_out, foreign_engine.MOST_SECONDS)
        if not trials:
            raise SpecError(
                "no held-out recording to step", where="--engine",
                expected="--held-out RECORDING",
            )  # fmt: skip
        foreign_engine.check_engine(source.engine, realization, trials)
    families = {name: law.family for name, law in catalogue().items()}

    def expressed(approximated: Mapping[str, str]) -> tuple[Expression, ...]:
        return expressions(source.patched, target.written, approximated, families)

    incomplete = {e.joint for e in expressed({}) if e.verdict == "lost"}
    reference: measure.Errors = {}
    errors: measure.Errors = {}
    errors_as_is: measure.Errors = {}
    complete: measure.Errors = {}
    integrator = int(realization.model.opt.integrator)
    steps = [Integration(integrator, n, f"that of {target.engine}") for n in _DIVISORS]
    chosen = steps[0]

    def measured(integration: Integration) -> measure.Errors:
        assert source.engine is not None
        _write(target, source, folder, rows, integration)
        return foreign_engine.engine_errors(
            source.engine, target.stepper, folder, realization, trials, integration.divisor
        )

    if trials:
        reference = measure.patched_errors(realization, source.loaded.patched, trials)
        # A lost effect hides what the time step costs at its joint.
        complete = {j: error for j, error in reference.items() if j not in incomplete}
        complete = complete or reference
        chosen, errors, errors_as_is = measure.first_within(steps, measured, complete)
    _write(target, source, folder, rows, chosen)
    approximated = dict(target.approximated)
    rounded = rounding_note(rows, table.timestep / chosen.divisor)
    if rounded:
        approximated["delay"] = rounded
    found = expressed(approximated)
    files = (target.file, MODEL_FILE)
    if not trials:
        comparison = f"not stepped here: fields of {target.engine}"
        matrix = tuple(effect_row(e, source, comparison, None) for e in found)
        return Exported(files, target.engine, "schema", matrix, {}, tuple(_notes(target, table)))
    increase = measure.increase(errors, reference)
    matrix = tuple(measured_row(e, source, trials, reference, increase, incomplete) for e in found)
    step = integration_row(steps[0], chosen, complete, errors, errors_as_is)
    return Exported(
        files,
        target.engine,
        "stepped",
        (*matrix, step),
        joint_errors(realization, reference, errors),
        tuple(_notes(target, table)[:-1]),
    )


def _write(
    target: ConfigTarget,
    source: ExportSource,
    folder: Path,
    rows: Sequence[DriveRow],
    integration: Integration,
) -> None:
    """Write all files for one time step."""
    realization = source.loaded.realization
    spec = realization.spec.copy()
    integration.apply(spec)
    atomic.write_text(folder / target.file, target.render(rows, float(spec.option.timestep)))
    if target.actuators != "kept":
        for actuator in list(spec.actuators):
            spec.delete(actuator)
    if target.actuators == "motors":
        for row in rows:
            _add_motor(spec, row)
    text = mjcf_file.with_exact_inertia(spec, spec.compile())
    if target.actuators == "motors":
        text = _with_motor_tags(text)
    atomic.write_text(folder / MODEL_FILE, text)
    copy_assets(realization, folder)
    mujoco.MjModel.from_xml_path(str(folder / MODEL_FILE))


def _add_motor(spec: mujoco.MjSpec, row: DriveRow) -> None:
    motor = spec.add_actuator(name=row.joint, target=row.joint)
    motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    motor.set_to_motor()
    if row.effort_limit is not None:
        motor.forcelimited = motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcerange = motor.ctrlrange = [-row.effort_limit, row.effort_limit]


def _with_motor_tags(text: str) -> str:
    """The MJCF with ``motor`` elements, where MuJoCo writes ``general`` ones."""
    root = etree.fromstring(text.encode())
    for actuator in root.iterfind("actuator/*"):
        actuator.tag = "motor"
        for name in set(actuator.attrib) - set(_MOTOR_ATTRIBUTES):
            del actuator.attrib[name]
    return str(etree.tostring(root, encoding="unicode")) + "\n"


def _notes(target: ConfigTarget, table: DriveTable) -> list[str]:
    skipped = [
        f"{row.joint}: {row.mode} commands have no configuration here"
        for row in table.rows
        if row.mode not in target.modes
    ]
    omitted = [f"{joint}: {why}" for joint, why in table.omitted.items()]
    return [
        *skipped,
        *omitted,
        "the loss of the simulator's own integration is not measured",
    ]


def arguments(**values: object) -> str:
    """Keyword arguments as Python text; those that are None are left out."""
    return ", ".join(f"{name}={value}" for name, value in values.items() if value is not None)


def number(value: float | None) -> str | None:
    """A number as Python text, None for None."""
    return None if value is None else repr(float(f"{value:.9g}"))


def python_module(
    template: str, rows: Sequence[DriveRow], timestep: float, call: Callable[[DriveRow], str]
) -> str:
    """Text of a Python module with one call for each drive.

    Args:
        template: the module, with ``{calls}`` and ``{timestep}``.
        rows: the drives.
        timestep: s.
        call: one drive -> Python text, with ``steps(delay)`` for a delay in time steps.
    """
    calls = "".join(f"        {call(row)},\n" for row in rows)
    text = template.format(calls=calls, timestep=repr(timestep))
    compile(text, "actuators", "exec")
    return text
