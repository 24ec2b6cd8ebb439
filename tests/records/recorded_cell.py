"""A small cell whose twin lists a record of each kind; records are written, not estimated."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pytest_twin.calibration.basis import calibration_basis
from pytest_twin.calibration.plan import load_plan
from pytest_twin.realization import load
from pytest_twin.realization.record_inputs import basis_json, states_of_records, unfitted
from pytest_twin.records.basis import Uses
from pytest_twin.records.state import RecordState
from pytest_twin.twin import load_twin

MODEL = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.002" gravity="0 0 -9.81"/>
  <asset><material name="paint" rgba="0.2 0.3 0.4 1"/></asset>
  <worldbody>
    <body name="upper" pos="0 0 0.2">
      <inertial pos="0.15 0 0" mass="1.2" diaginertia="0.002 0.01 0.01"/>
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5" damping="0.5" armature="0.02"/>
      <geom name="cover" type="box" size="0.03 0.03 0.03" contype="0" conaffinity="0"
            material="paint"/>
      <body name="fore" pos="0.3 0 0">
        <inertial pos="0.1 0 0" mass="0.6" diaginertia="0.001 0.004 0.004"/>
        <joint name="elbow" axis="0 1 0" range="-2 2" damping="0.2" frictionloss="0.1"/>
        <site name="tcp" pos="0.25 0 0"/>
      </body>
    </body>
    <body name="turntable" pos="2 0 0">
      <inertial pos="0 0 0" mass="3" diaginertia="0.01 0.01 0.01"/>
      <joint name="spin" axis="0 0 1" damping="0.1"/>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="40"/>
    <position name="elbow" joint="elbow" kp="20"/>
  </actuator>
</mujoco>
"""
TWIN = """name: cell
model: arm.xml
tcp: tcp
controllers:
  soft: {elbow: {kp: 10}}
  stiff: {elbow: {kp: 80}}
payloads:
  kg05: {fore: {mass: 0.5, com: [0.2, 0, 0]}}
  kg10: {fore: {mass: 1.0, com: [0.2, 0, 0]}}
calibration: {id: wiring, joints: {elbow: {sign: -1, offset: 0.01}}}
fit:
- {id: gains, actuator: {shoulder: {kp: 55}}}
"""
LISTED_FIT = "- {file: identified/identification.json}\n"
LISTED_CALIBRATION = "calibrations: [{file: measured/calibration.json}]\n"
PLAN = """calibration: zeros
robot: twin.yaml
flange: tcp
observations: observations.csv
estimate: [joint_zeros]
"""
OBSERVATIONS = "id,joint.shoulder,joint.elbow\n1,0.10,0.20\n2,0.30,0.40\n"
FIT: Mapping[str, Any] = {
    "body": {
        "upper": {"mass": 1.3, "com": [0.16, 0, 0], "inertia": [0.002, 0.011, 0.011, 0, 0, 0]},
        "fore": {"mass": 0.7, "com": [0.11, 0, 0], "inertia": [0.001, 0.005, 0.005, 0, 0, 0]},
    },
    "joint": {"elbow": {"damping": 0.33, "frictionloss": 0.2}},
    "actuator": {"shoulder": {"kp": 60}, "elbow": {"kp": 25}},
}


def write_cell(root: Path, model: str = MODEL) -> Path:
    """Write the twin, and its records as commands write them for it."""
    (root / "arm.xml").write_text(model)
    (root / "twin.yaml").write_text(TWIN)
    (root / "one.csv").write_text("time,elbow.position\n0,0.1\n0.01,0.2\n")
    (root / "plan.yaml").write_text(PLAN)
    (root / "observations.csv").write_text(OBSERVATIONS)
    write_calibration(root)
    (root / "twin.yaml").write_text(TWIN + LISTED_CALIBRATION)
    write_identification(root)
    (root / "twin.yaml").write_text(TWIN + LISTED_FIT + LISTED_CALIBRATION)
    return root


def write_identification(root: Path, ident: str = "identified") -> Path:
    """Write the record of an identification of both joints with one payload and controller."""
    twin = load_twin(root / "twin.yaml").before_fit(ident)
    realization = load(twin.first_realization.file, twin=twin)
    uses = Uses(joints=("shoulder", "elbow"), controllers=("soft",), payloads=("kg05",))
    folder = root / ident
    folder.mkdir(exist_ok=True)
    basis = basis_json(
        unfitted(realization), uses, twin, folder, {"one.csv": root / "one.csv"}, has_twin=True
    )
    document = {
        "schema": 1,
        "identification": ident,
        "verdict": "accepted",
        "stages": [{"stage": "friction", "state": "accepted"}],
        "parameters": {},
        "covariance": {"names": [], "matrix": []},
        "held_out": {},
        "trials": {"fit": ["one.csv"], "held_out": []},
        "fit": FIT,
        "basis": basis,
    }
    path = folder / "identification.json"
    path.write_text(json.dumps(document))
    return path


def write_calibration(root: Path) -> Path:
    """Write the record of a calibration of the joint zeros."""
    plan = load_plan(root / "plan.yaml")
    folder = root / "measured"
    folder.mkdir(exist_ok=True)
    assert plan.robot is not None
    inputs = ("plan.yaml", "observations.csv", plan.robot.name)
    document = {
        "schema": 1,
        "calibration": "zeros",
        "verdict": "accepted",
        "records": {"joint_zeros": {"values": {"shoulder": {"value": 0.02, "unit": "rad"}}}},
        "held_out": {"translation_rms": 0.001},
        "covariance": {"of": [], "matrix": []},
        "basis": calibration_basis(plan, inputs, folder),
    }
    path = folder / "calibration.json"
    path.write_text(json.dumps(document))
    return path


def states(root: Path) -> dict[str, RecordState]:
    """States of the records of the twin, by id."""
    return {state.record.id: state for state in states_of_records(load_twin(root / "twin.yaml"))}


def changed(root: Path) -> dict[str, list[str]]:
    """Record -> its changed inputs in words; records without a change are left out."""
    return {
        ident: [str(reason) for change in state.touching for reason in change.reasons]
        for ident, state in states(root).items()
        if state.touching
    }


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
