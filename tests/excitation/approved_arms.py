"""A planar arm with servos and a floor, random robots, and approved limits for them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from pytest_twin.excitation.clearance import ClearanceChecker
from pytest_twin.excitation.excite import Excitation
from pytest_twin.realization.collision import enabled_pairs
from pytest_twin.realization.loading import load
from pytest_twin.realization.model import Realization
from pytest_twin.strategies.drawn_robot import DrawnRobot
from pytest_twin.twin import Twin, load_twin

ARM = """\
<mujoco model="arm"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><geom type="capsule" size=".03"/></default><worldbody>
<geom name="floor" type="plane" size="2 2 .1" pos="0 0 -.5"/>
<body name="upper" pos="0 0 0">
<joint name="lift" axis="0 1 0" range="-2 2" damping=".3" armature=".02" frictionloss=".2"/>
<geom fromto="0 0 0 .25 0 0" mass=".7"/>
<body name="lower" pos=".25 0 0">
<joint name="elbow" axis="0 1 0" range="-2.5 2.5" damping=".1" armature=".01" frictionloss=".1"/>
<geom fromto=".06 0 0 .15 0 0" mass=".3"/><site name="tip" pos=".15 0 0"/>
</body></body></worldbody>
<actuator><position joint="lift" kp="280" kv="8" forcerange="-20 20"/>
<position joint="elbow" kp="100" kv="2" forcerange="-8 8"/></actuator></mujoco>
"""


@dataclass(frozen=True)
class Excited:
    """The excitation designed for the planar arm.

    Attributes:
        folder: folder of the twin; its subfolder ``out`` has the written files.
        found: designed excitation.
        document: content of ``excitation.json``.
    """

    folder: Path
    found: Excitation
    document: dict[str, Any]


def approved_for_arm(**changes: Any) -> dict[str, Any]:
    """Section ``excitation:`` with the approved limits of the planar arm."""
    joint = {"velocity": 2.0, "acceleration": 6.0, "effort_noise": 0.02}
    section: dict[str, Any] = {
        "approved_by": "A. Engineer",
        "mechanisms": ["delay", "friction", "gravity", "inertia"],
        "duration": 8.0,
        "rate": 50.0,
        "task_band": [0.25, 2.0],
        "joints": {
            "lift": {**joint, "position": [-1.2, 1.2], "effort": 12.0, "start": 0.0},
            "elbow": {**joint, "position": [-1.5, 1.5], "effort": 4.0, "start": 0.3},
        },
        "workspace": [{"frame": "tip", "min": [-1.0, -1.0, -0.45], "max": [1.0, 1.0, 1.0]}],
        "clearance": {"self": 0.01, "environment": 0.02},
        "supply": {"voltage": 48.0, "current": 10.0},
        "stop": {"category": 1, "reaction": 0.1, "plan": "enabling switch"},
    }
    return {**section, **changes}


def write_twin(folder: Path, section: Any, model: str = ARM, name: str = "arm.xml") -> Path:
    """Write a model and a ``twin.yaml`` with the section ``excitation:``."""
    (folder / name).write_text(model)
    text = yaml.safe_dump({"model": name, "excitation": section}, sort_keys=False)
    (folder / "twin.yaml").write_text(text)
    return folder / "twin.yaml"


def loaded(path: Path) -> tuple[Realization, Twin]:
    """The realization of a twin, and the twin."""
    twin = load_twin(path)
    return load(twin.realizations["mujoco"].file, twin=twin), twin


def write_drawn(folder: Path, robot: DrawnRobot, seed: int) -> Path:
    """Write a random serial robot with strong drives and random approved limits within its own.

    Pairs of links that overlap at the start are excluded from the clearance.
    """
    random = np.random.default_rng(seed)
    robot = replace(
        robot, joints=tuple(replace(one, effort=1e4) for one in robot.joints if one.kind)
    )
    realization = load(robot.write(folder))
    joints: dict[str, dict[str, Any]] = {}
    for one in robot.joints:
        if one.kind == "fixed":
            continue
        low, high = one.limits if one.limits is not None else (-2.0, 2.0)
        start = float(random.uniform(low + 0.3 * (high - low), high - 0.3 * (high - low)))
        joints[one.name] = {
            "position": [low, high],
            "velocity": float(random.uniform(0.3, 1.0)) * float(one.velocity or 1.0),
            "acceleration": float(random.uniform(1.0, 10.0)),
            "effort": 9e3,
            "start": start,
        }
    clearance: Any = {"self": 0.005, "environment": 0.005}
    section = approved_for_arm(
        joints=joints,
        workspace=[],
        clearance="none",
        duration=5.0,
        supply={"voltage": 1e4, "current": 1e4},
    )
    path = write_twin(folder, section, robot.urdf, "drawn.urdf")
    if enabled_pairs(realization):
        section["clearance"] = clearance
        clearance["ignore"] = _overlapping_pairs(path, section)
        path = write_twin(folder, section, robot.urdf, "drawn.urdf")
    return path


def _overlapping_pairs(path: Path, section: dict[str, Any]) -> list[list[str]]:
    from pytest_twin.excitation.read_limits import read_approved

    wide = {**section, "clearance": {"self": 0.1, "environment": 0.1}}
    path.write_text(yaml.safe_dump({"model": "drawn.urdf", "excitation": wide}))
    realization, twin = loaded(path)
    approved = read_approved(realization, twin)
    return [
        list(one.pair) for one in ClearanceChecker(realization, approved).too_near(approved.start)
    ]


def pairs_in_contact(
    realization: Realization, positions: dict[str, np.ndarray]
) -> set[frozenset[str]]:
    """Pairs of bodies in contact at any of the poses, as MuJoCo's own collision detection says.

    Args:
        positions: joint -> (n,) rad or m.
    """
    model = realization.model
    data = mujoco.MjData(model)
    found = set()
    count = len(next(iter(positions.values())))
    for at in range(count):
        data.qpos[:] = model.qpos0
        for joint, values in positions.items():
            data.qpos[realization.joint_qpos_index(joint)] = values[at]
        mujoco.mj_fwdPosition(model, data)
        for contact in data.contact[: data.ncon]:
            bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
            if contact.dist <= 0.0:
                found.add(frozenset(model.body(body).name for body in bodies))
    return found
