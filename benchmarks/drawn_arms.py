"""An arm of three joints with random parameters, for benchmarks of identification and ranges."""

from __future__ import annotations

import numpy as np

JOINTS = ("shoulder", "elbow", "wrist")
LINKS = """
    <body name="upper">
      <inertial pos="{c0} 0.01 0.02" mass="{m0}" diaginertia="0.03 0.1 0.1"/>
      <joint name="shoulder" axis="0 1 0" armature="{a0}" damping="{d0}" frictionloss="{f0}"/>
      <body name="lower" pos="0.5 0 0">
        <inertial pos="{c1} 0 0.02" mass="{m1}" diaginertia="0.02 0.05 0.05"/>
        <joint name="elbow" axis="0 0 1" armature="{a1}" damping="{d1}" frictionloss="{f1}"/>
        <body name="hand" pos="0.4 0 0">
          <inertial pos="{c2} 0.02 0.01" mass="{m2}" diaginertia="0.005 0.01 0.01"/>
          <joint name="wrist" axis="0 1 0" armature="{a2}" damping="{d2}" frictionloss="{f2}"/>
        </body>
      </body>
    </body>"""
"""MJCF of the links: masses ``m`` (kg), centres ``c`` (m), armature, damping and dry friction."""


def nominal_parameters() -> dict[str, float]:
    """Parameters of the nominal arm, without friction."""
    values = {}
    for k, (mass, com) in enumerate(((4.0, 0.25), (2.5, 0.2), (1.0, 0.1))):
        values |= {f"m{k}": mass, f"c{k}": com, f"a{k}": 0.1 / (k + 1), f"d{k}": 0.0, f"f{k}": 0.0}
    return values


def true_parameters(random: np.random.Generator) -> dict[str, float]:
    """Parameters that differ by up to 40 % from the nominal ones, with friction."""
    values = {key: value * random.uniform(0.7, 1.4) for key, value in nominal_parameters().items()}
    for k in range(3):
        values[f"d{k}"] = random.uniform(0.3, 2.0) / (k + 1)
        values[f"f{k}"] = random.uniform(0.2, 1.5) / (k + 1)
    return values
