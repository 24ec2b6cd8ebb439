"""An arm with three joints and a tool at the wrist, as a MuJoCo and a Pinocchio model."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

START = 1_700_000_000_000_000_000
PERIOD = 0.004
COM, MASS = np.array([0.02, -0.03, 0.08]), 1.5
INERTIA = np.diag([0.006, 0.005, 0.004])
ARM = f"""<mujoco><compiler angle="radian"/><worldbody>
  <body name="a" pos="0 0 0.3"><joint name="j1" axis="0 0 1"/><inertial pos="0 0 0" mass="1"
    diaginertia="0.01 0.01 0.01"/>
  <body name="b" pos="0.2 0 0"><joint name="j2" axis="0 1 0"/><inertial pos="0 0 0" mass="1"
    diaginertia="0.01 0.01 0.01"/>
  <body name="c" pos="0.2 0 0"><joint name="j3" axis="1 0 0"/><inertial pos="0 0 0" mass="1"
    diaginertia="0.01 0.01 0.01"/>
  <body name="tool" pos="0.1 0 0"><site name="wrist"/><inertial pos="{COM[0]} {COM[1]} {COM[2]}"
    mass="{MASS}" diaginertia="{INERTIA[0, 0]} {INERTIA[1, 1]} {INERTIA[2, 2]}"/></body>
  </body></body></body></worldbody></mujoco>"""


def pinocchio_arm() -> pin.Model:
    model = pin.Model()
    joints = [pin.JointModelRZ(), pin.JointModelRY(), pin.JointModelRX()]
    at = [[0, 0, 0.3], [0.2, 0, 0], [0.2, 0, 0]]
    parent = 0
    for name, joint, place in zip(("j1", "j2", "j3"), joints, at, strict=True):
        parent = model.addJoint(parent, joint, pin.SE3(np.eye(3), np.array(place, float)), name)
        own = pin.Inertia(1.0, np.zeros(3), 0.01 * np.eye(3))
        model.appendBodyToJoint(parent, own, pin.SE3.Identity())
    return model


def random_motion(seed: int, seconds: float = 16.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, PERIOD)
    q, v, a = np.zeros((3, len(time), 3))
    for joint in range(3):
        for rate in rng.uniform(0.1, 0.8, 5):
            size, phase = rng.uniform(0.2, 0.5), rng.uniform(0.0, 2.0 * np.pi)
            w = 2.0 * np.pi * rate
            q[:, joint] += size * np.sin(w * time + phase)
            v[:, joint] += size * w * np.cos(w * time + phase)
            a[:, joint] -= size * w**2 * np.sin(w * time + phase)
    return q, v, a
