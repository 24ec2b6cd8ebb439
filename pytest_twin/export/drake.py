"""Drives for Drake: the robot with motors, and gains that are set on its ``MultibodyPlant``."""

from __future__ import annotations

from pathlib import Path

from pytest_twin.export.config_target import ConfigTarget, export_config, number, python_module
from pytest_twin.export.drive_table import DriveRow
from pytest_twin.export.source import ExportSource
from pytest_twin.export.target import Exported

_MODULE = '''"""Identified drives for Drake, written by pytest-twin export.

Call ``add_robot(plant)`` before ``plant.Finalize()``, on a plant with a discrete time step. Send
positions and velocities to ``plant.get_desired_state_input_port(instance)``.
"""

from pathlib import Path

from pydrake.multibody.parsing import Parser
from pydrake.multibody.tree import PdControllerGains

GAINS = dict(
    [
{calls}    ]
)


def add_robot(plant):
    """Add the robot with its drives; return its model instance."""
    (instance,) = Parser(plant).AddModels(str(Path(__file__).with_name("model.xml")))
    for name, (p, d) in GAINS.items():
        actuator = plant.GetJointActuatorByName(name, instance)
        actuator.set_controller_gains(PdControllerGains(p=p, d=d))
    return instance
'''


def _call(row: DriveRow) -> str:
    return f"({row.joint!r}, ({number(row.stiffness)}, {number(row.damping)}))"


TARGET = ConfigTarget(
    file="drake_drives.py",
    engine="drake 1.51",
    render=lambda rows, timestep: python_module(_MODULE, rows, timestep, _call),
    written={
        "gains": "PdControllerGains",
        "effort_limit": "effort limit of the motor",
        "armature": "rotor inertia, from the armature of the joint",
        "viscous": "damping of the joint",
    },
    approximated={},
    modes=("position",),
    actuators="motors",
    stepper="step_drake.py",
)


def export(source: ExportSource, folder: Path) -> Exported:
    """Write ``drake_drives.py`` and the robot with motors into an empty folder.

    Raises:
        TwinError: as :func:`export_config`.
    """
    return export_config(TARGET, source, folder)
