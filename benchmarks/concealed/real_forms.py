"""Write a validated model of a real machine as case files, and compile it for MuJoCo."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from real_models import Machine
from real_replay import Floats, Law

GRAVITY = 9.81


def gravity(tilt: tuple[float, float]) -> Floats:
    """(3,) gravity in the frame of a base that rolls about x and pitches about y, m/s^2."""
    roll, pitch = tilt
    x, y, z = 0.0, -GRAVITY * np.sin(roll), -GRAVITY * np.cos(roll)
    return np.array(
        [x * np.cos(pitch) - z * np.sin(pitch), y, x * np.sin(pitch) + z * np.cos(pitch)]
    )


def mjcf(machine: Machine, recordings: Path) -> str:
    """Return the model as MJCF, from the file in the folder of the recordings."""
    root = ElementTree.fromstring((recordings / machine.folder / "model.xml").read_text("utf-8"))
    option = root.find("option")
    assert option is not None
    option.set("gravity", _words(gravity(machine.tilt)))
    step = float(option.get("timestep", "0.002"))
    for body in root.iter("body"):
        name = body.get("name", "")
        if name in machine.mass:
            _inertial(body).set("mass", repr(machine.mass[name]))
        joint = body.find("joint")
        if joint is None:
            continue
        drive = machine.drives.get(joint.get("name", ""))
        if drive is None:
            body.remove(joint)
            _turn(body, joint, machine.held[joint.get("name", "")])
            continue
        joint.set("damping", repr(drive.damping))
        joint.set("frictionloss", repr(drive.friction))
        joint.set("armature", repr(drive.armature))
        if drive.spring:
            joint.set("stiffness", repr(drive.spring))
        # Dry friction is made stiff, because MuJoCo's default creeps under load.
        joint.set("solreffriction", _words([2.0 * step, 1.0]))
        joint.set("solimpfriction", "0.999 0.9999 0.001 0.5 2")
        if drive.zero:
            _turn(body, joint, drive.zero)
    actuators = root.find("actuator")
    assert actuators is not None
    for actuator in list(actuators):
        driven = machine.drives.get(actuator.get("joint", ""))
        if driven is None:
            actuators.remove(actuator)
        elif driven.kp:
            actuator.set("kp", repr(driven.kp))
            actuator.set("kv", repr(driven.kv))
        if machine.limit is not None:
            actuator.set("forcerange", _words([-machine.limit, machine.limit]))
    return ElementTree.tostring(root, "unicode") + "\n"


def effects_json(machine: Machine) -> str | None:
    """Return effects that MJCF cannot express, in the form of a diagnosis; None without any."""
    if not machine.beside:
        return None
    effects = [
        {"effect": effect, "joint": joint, "values": dict(values), "in_model": False}
        for effect, joint, values in machine.beside
    ]
    return json.dumps({"schema": 1, "joints": list(machine.joints), "effects": effects}, indent=1)


def twin_yaml(machine: Machine) -> str | None:
    """Return gains by the trial's controller; None if there is only one controller."""
    if not machine.controllers:
        return None
    lines = [f"  {name}: {{servo: {{kp: {kp!r}}}}}" for name, kp in machine.controllers.items()]
    return "\n".join(["model: model.xml", "controllers:", *lines]) + "\n"


def push(machine: Machine) -> Floats:
    """(joints,) constant effort of the independent replay, from direction-dependent friction."""
    return np.array(
        [
            d.preload - machine.value("asymmetric_friction", "offset", joint)
            for joint, d in machine.drives.items()
        ]
    )


def law(machine: Machine, controller: str | None = None) -> Law | None:
    """Effects that MJCF cannot express, except constant ones, delays and sensor effects."""
    return _xl330(machine, controller or "") if machine.controllers else None


def _xl330(machine: Machine, controller: str) -> Law:
    """Servo with torque roll-off, and gear friction that depends on motor effort and load."""
    kp, limit = machine.controllers[controller], machine.limit or np.inf
    drive = machine.drives["pendulum"]
    inverse, emf = (machine.value("torque_rolloff", n) for n in ("inverse_knee", "back_emf"))
    rub = {
        n: machine.value("motor_load_friction", n)
        for n in ("coefficient", "stiction_excess", "stribeck_velocity")
    }
    by_load = machine.value("load_dependent_friction", "coefficient")

    def act(model: mujoco.MjModel, data: mujoco.MjData, command: Floats) -> None:
        q, v = data.qpos[0], data.qvel[0]
        asked = min(max(kp * (command[0] - q), -limit), limit)
        taken = emf * v if inverse else 0.0
        effort = (asked - taken) / (1.0 + abs(asked - taken) * inverse)
        fall = np.exp(-abs(v) / rub["stribeck_velocity"]) if rub["stribeck_velocity"] else 0.0
        share = rub["coefficient"] + rub["stiction_excess"] * fall
        mass, lever = model.body_mass[1], -model.body_ipos[1, 2]
        load = abs(
            mass * lever * (model.opt.gravity[0] * np.cos(q) + model.opt.gravity[2] * np.sin(q))
        )
        model.dof_frictionloss[0] = drive.friction + by_load * load + share * abs(effort)
        # The MJCF's servo is inactive here: ``compiled`` sets its gain to zero.
        data.qfrc_applied[0] = effort + taken + drive.preload

    return act


def compiled(machine: Machine, recordings: Path) -> mujoco.MjModel:
    """Return the model for the independent replay."""
    model = mujoco.MjModel.from_xml_string(mjcf(machine, recordings))
    if machine.controllers:
        model.actuator_gainprm[:] = 0.0
        model.actuator_biasprm[:] = 0.0
    return model


def _inertial(body: ElementTree.Element) -> ElementTree.Element:
    found = body.find("inertial")
    assert found is not None
    return found


def _turn(body: ElementTree.Element, joint: ElementTree.Element, angle: float) -> None:
    """Rotate a body by an angle about the axis of its joint."""
    before = np.array(body.get("quat", "1 0 0 0").split(), float)
    axis = np.array(joint.get("axis", "0 0 1").split(), float)
    by, after = np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(by, axis / np.linalg.norm(axis), angle)
    mujoco.mju_mulQuat(after, before / np.linalg.norm(before), by)
    body.set("quat", _words(after))


def _words(values: Any) -> str:
    return " ".join(repr(float(v)) for v in values)
