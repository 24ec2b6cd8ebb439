"""Actuators and passive joint forces for Newton, in USD with ``newton-usd-schemas``.

The layer is composed over the robot's stage, whose joints are prims below ``/ROBOT/Physics``, as
``pytest-twin realize`` writes them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from pytest_twin.export.config_target import ConfigTarget, export_config, number
from pytest_twin.export.drive_table import DriveRow, steps_of
from pytest_twin.export.source import ExportSource
from pytest_twin.export.target import Exported

_MODULE = '''#usda 1.0
(
    doc = """Identified drives, written by pytest-twin export. Add this layer to the subLayers of
    the robot's stage. Delays are steps of {timestep} s."""
)

over "ROBOT"
{{
    over "Physics"
    {{
{joints}    }}

    def Scope "Actuators"
    {{
{actuators}    }}
}}
'''


def _render(rows: Sequence[DriveRow], timestep: float) -> str:
    return _MODULE.format(
        joints="".join(_joint(row) for row in rows),
        actuators="".join(_actuator(row, timestep) for row in rows),
        timestep=repr(timestep),
    )


def _name(row: DriveRow) -> str:
    return re.sub(r"\W|^(?=\d)", "_", row.joint, flags=re.ASCII)


def _joint(row: DriveRow) -> str:
    # Angular damping of a joint is per degree, gains of an actuator are per radian.
    damping = row.viscous if row.is_slide else math.radians(row.viscous)
    return f"""        over "{_name(row)}" (
            prepend apiSchemas = ["NewtonJointAPI"]
        )
        {{
            float newton:armature = {number(row.armature)}
            float newton:damping = {number(damping)}
            float newton:friction = {number(row.friction)}
        }}
"""


def _actuator(row: DriveRow, timestep: float) -> str:
    schemas = ["NewtonPDControlAPI"]
    lines = [
        f"float newton:kp = {number(row.stiffness)}",
        f"float newton:kd = {number(row.damping)}",
    ]
    if row.integral_gain > 0.0:
        schemas[0] = "NewtonPIDControlAPI"
        lines.append(f"float newton:ki = {number(row.integral_gain)}")
    if row.stall > 0.0:
        schemas.append("NewtonDCMotorClampingAPI")
        most = row.stall if row.effort_limit is None else min(row.stall, row.effort_limit)
        lines += [
            f"float newton:saturationEffort = {number(row.stall)}",
            f"float newton:velocityLimit = {number(row.no_load_speed)}",
            f"float newton:maxMotorEffort = {number(most)}",
        ]
    elif row.effort_limit is not None:
        schemas.append("NewtonMaxEffortClampingAPI")
        lines.append(f"float newton:maxEffort = {number(row.effort_limit)}")
    steps = steps_of(row.delay, timestep)
    if steps > 0:
        schemas.append("NewtonActuatorDelayAPI")
        lines.append(f"int newton:delaySteps = {steps}")
    listed = ", ".join(f'"{schema}"' for schema in schemas)
    driven = "\n".join(f"            {line}" for line in lines)
    return f"""        def NewtonActuator "{_name(row)}" (
            prepend apiSchemas = [{listed}]
        )
        {{
            rel newton:targets = </ROBOT/Physics/{_name(row)}>
{driven}
        }}
"""


TARGET = ConfigTarget(
    file="newton_actuators.usda",
    engine="newton 1.8",
    render=_render,
    written={
        "gains": "NewtonPDControlAPI kp, kd",
        "effort_limit": "NewtonMaxEffortClampingAPI maxEffort",
        "armature": "NewtonJointAPI armature",
        "friction": "NewtonJointAPI friction",
        "viscous": "NewtonJointAPI damping",
        "delay": "NewtonActuatorDelayAPI delaySteps",
        "speed_limit": "NewtonDCMotorClampingAPI saturationEffort, velocityLimit",
        "integral": "NewtonPIDControlAPI ki",
    },
    approximated={},
    modes=("position", "velocity", "effort"),
    # Those of the layer act; kept ones would act too.
    actuators="none",
    stepper="step_newton.py",
)


def export(source: ExportSource, folder: Path) -> Exported:
    """Write ``newton_actuators.usda`` and the robot's MJCF into an empty folder.

    Raises:
        TwinError: as :func:`export_config`.
    """
    return export_config(TARGET, source, folder)
