"""Actuator configurations of Isaac Lab 2.3 and 3.0 (``isaaclab.actuators``)."""

from __future__ import annotations

import re
from pathlib import Path

from pytest_twin.export.config_target import (
    ConfigTarget,
    arguments,
    export_config,
    number,
    python_module,
)
from pytest_twin.export.drive_table import DriveRow
from pytest_twin.export.source import ExportSource
from pytest_twin.export.target import Exported

_MODULE = '''"""Identified actuators for Isaac Lab, written by pytest-twin export.

Use them as ``ArticulationCfg(actuators=actuators(sim_dt))``.
"""

from isaaclab.actuators import DCMotorCfg, DelayedPDActuatorCfg, IdealPDActuatorCfg

# Isaac Lab 3.0 gave both limits of an actuator other names.
PREFIX = "actuator_" if hasattr(IdealPDActuatorCfg, "actuator_effort_limit") else ""


def limits(**values):
    return {{PREFIX + name: value for name, value in values.items()}}


def actuators(physics_dt={timestep}):
    """Configurations for a physics time step in s: delays are whole steps."""

    def steps(delay):
        return int(delay / physics_dt + 0.5)

    return {{
{calls}    }}
'''


def _call(row: DriveRow) -> str:
    kind, more = "IdealPDActuatorCfg", ""
    if row.stall > 0.0:
        kind = "DCMotorCfg"
        more = arguments(saturation_effort=number(row.stall))
    elif row.delay > 0.0:
        kind = "DelayedPDActuatorCfg"
        delay = f"steps({number(row.delay)})"
        more = arguments(min_delay=delay, max_delay=delay)
    limit = row.effort_limit
    if row.stall > 0.0:
        limit = row.stall if limit is None else min(limit, row.stall)
    speed = number(row.no_load_speed) if row.stall > 0.0 else None
    limits = arguments(effort_limit=number(limit), velocity_limit=speed)
    fields = arguments(
        joint_names_expr=repr([re.escape(row.joint)]),
        stiffness=number(row.stiffness),
        damping=number(row.damping),
        armature=number(row.armature),
        friction=number(row.stiction),
        dynamic_friction=number(row.friction),
        viscous_friction=number(row.viscous),
    )
    if limits:
        more += f"{', ' if more else ''}**limits({limits})"
    return f"{row.joint!r}: {kind}({fields}{', ' if more else ''}{more})"


TARGET = ConfigTarget(
    file="isaaclab_actuators.py",
    engine="isaaclab 2.3 and 3.0",
    render=lambda rows, timestep: python_module(_MODULE, rows, timestep, _call),
    written={
        "gains": "stiffness, damping",
        "effort_limit": "effort_limit",
        "armature": "armature",
        "friction": "friction, dynamic_friction",
        "viscous": "field viscous_friction",
        "stiction": "friction, dynamic_friction",
        "delay": "DelayedPDActuatorCfg min_delay, max_delay",
        "speed_limit": "DCMotorCfg saturation_effort, velocity_limit",
    },
    approximated={
        "stiction": "static and dynamic friction without a Stribeck velocity",
        "speed_limit": "a DCMotorCfg has no delay: a delay of the same joint is lost",
    },
    modes=("position", "velocity", "effort"),
    actuators="kept",
)


def export(source: ExportSource, folder: Path) -> Exported:
    """Write ``isaaclab_actuators.py`` and the robot's file into an empty folder.

    Raises:
        TwinError: as :func:`export_config`.
    """
    return export_config(TARGET, source, folder)
