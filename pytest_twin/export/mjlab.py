"""Actuator configurations of mjlab (``mjlab.actuator``), and the robot as its ``spec_fn``."""

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

_MODULE = '''"""Identified actuators for mjlab, written by pytest-twin export.

Use them as ``EntityCfg(spec_fn=spec, articulation=info)`` with
``info = EntityArticulationInfoCfg(actuators=actuators(physics_dt))``.
"""

from pathlib import Path

import mujoco
from mjlab.actuator import (
    BuiltinMotorActuatorCfg,
    BuiltinPositionActuatorCfg,
    BuiltinVelocityActuatorCfg,
    DcMotorActuatorCfg,
)


def spec():
    """The robot without actuators."""
    return mujoco.MjSpec.from_file(str(Path(__file__).with_name("model.xml")))


def actuators(physics_dt={timestep}):
    """Configurations for a physics time step in s: delays are whole steps."""

    def steps(delay):
        return int(delay / physics_dt + 0.5)

    return (
{calls}    )
'''
_UNLIMITED = 1e9
"""Effort limit of a motor without a limit, which mjlab requires, N*m or N."""


def _call(row: DriveRow) -> str:
    lag = None if row.delay == 0.0 else f"steps({number(row.delay)})"
    limit, gains = number(row.effort_limit), {}
    if row.mode == "effort":
        kind, limit = "BuiltinMotorActuatorCfg", limit or number(_UNLIMITED)
    elif row.stall > 0.0:
        kind = "DcMotorActuatorCfg"
        limit = number(min(row.stall, row.effort_limit or row.stall))
        gains = {
            "stiffness": number(row.stiffness), "damping": number(row.damping),
            "saturation_effort": number(row.stall), "velocity_limit": number(row.no_load_speed),
        }  # fmt: skip
    elif row.mode == "velocity":
        kind, gains = "BuiltinVelocityActuatorCfg", {"damping": number(row.damping)}
    else:
        kind = "BuiltinPositionActuatorCfg"
        gains = {"stiffness": number(row.stiffness), "damping": number(row.damping)}
    fields = arguments(
        target_names_expr=f"({re.escape(row.joint)!r},)",
        **gains,
        effort_limit=limit,
        armature=number(row.armature),
        frictionloss=number(row.friction),
        viscous_damping=number(row.viscous),
        delay_min_lag=lag,
        delay_max_lag=lag,
    )
    return f"{kind}({fields})"


TARGET = ConfigTarget(
    file="mjlab_actuators.py",
    engine="mjlab 1.6",
    render=lambda rows, timestep: python_module(_MODULE, rows, timestep, _call),
    written={
        "gains": "stiffness, damping",
        "effort_limit": "effort_limit",
        "armature": "armature",
        "friction": "frictionloss",
        "viscous": "viscous_damping",
        "delay": "delay_min_lag, delay_max_lag",
        "speed_limit": "DcMotorActuatorCfg saturation_effort, velocity_limit",
    },
    approximated={},
    modes=("position", "velocity", "effort"),
    actuators="none",
    stepper="step_mjlab.py",
)


def export(source: ExportSource, folder: Path) -> Exported:
    """Write ``mjlab_actuators.py`` and the robot without actuators into an empty folder.

    Raises:
        TwinError: as :func:`export_config`.
    """
    return export_config(TARGET, source, folder)
