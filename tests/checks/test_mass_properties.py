from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from check_robots import (
    ARM,
    QUICK,
    failed,
    from_first,
    golden,
    measure,
    random_robots,
    record,
    robot,
)
from hypothesis import given

from pytest_twin.checks.mass_properties import MassProperties
from pytest_twin.errors import SpecError

CHECK = MassProperties()

PENDULUM = """
<mujoco><compiler angle="radian"/><worldbody>
  <body name="rod" pos="0 0 1"><joint name="swing" axis="0 1 0"/>
    <inertial mass="2" pos="0 0 -0.5" diaginertia="0.1 0.1 0.01"/>
    <body name="slider" pos="0 0 -1"><joint name="drop" type="slide" axis="0 0 1"/>
      <inertial mass="0.5" pos="0 0 0" diaginertia="0.01 0.01 0.01"/></body>
  </body></worldbody></mujoco>
"""


def arm_spec(**changes: object) -> object:
    fields = {
        "target": {"bodies": ["forearm"]},
        "stimulus": {"poses": ["reference", "home", {"seed": 1, "count": 4}]},
        "tolerance": {
            "mass": "0.1 g",
            "center_of_mass": "1 um",
            "gravity_torque": "1e-6 N*m",
            "gravity_force": "1e-6 N",
        },
    }
    return golden(CHECK, **fields | changes)


def test_mass_properties_of_a_pendulum_equal_the_closed_form(tmp_path: Path) -> None:
    pendulum = robot(tmp_path, PENDULUM)
    spec = arm_spec(
        target={},
        stimulus={"poses": [{"name": "out", "joints": {"swing": "30 deg", "drop": 0.2}}]},
    )
    observation = CHECK.observe(spec, pendulum, lambda fraction: None)
    g, sine, cosine = 9.81, 0.5, np.sqrt(0.75)
    moment = 2 * 0.5 + 0.5 * 0.8
    for source in (observation.values, observation.reference):
        assert source["mass"] == pytest.approx(2.5)
        # A positive rotation about y moves the hanging rod towards -x.
        np.testing.assert_allclose(
            source["center_of_mass"]["out"],
            [-sine * moment / 2.5, 0, 1 - cosine * moment / 2.5],
            atol=1e-12,
        )
        assert source["gravity"]["out"]["swing"] == pytest.approx(g * sine * moment)
        assert source["gravity"]["out"]["drop"] == pytest.approx(g * cosine * 0.5)
    measures = CHECK.compare(spec, observation, None)
    assert failed(measures) == []
    assert {(m.name, m.unit) for m in measures if "gravity" in m.name} == {
        ("gravity_torque", "N*m"),
        ("gravity_force", "N"),
    }


def test_mass_properties_of_an_unchanged_arm_pass_against_record_and_pinocchio(
    tmp_path: Path,
) -> None:
    arm = robot(tmp_path)
    measures = measure(CHECK, record(CHECK, arm_spec(), arm), arm)
    assert failed(measures) == []
    assert {m.against for m in measures} == {"golden", "pinocchio"}


FAULTS = {
    "a heavier link": (
        'size="0.025 0.02 0.08" mass="0.5"',
        'size="0.025 0.02 0.08" mass="0.51"',
        {"mass", "center_of_mass", "gravity_torque"},
    ),
    "a shifted mass": (
        'type="box" pos="0 0 0.1" size="0.025',
        'type="box" pos="0.001 0 0.1" size="0.025',
        {"center_of_mass", "gravity_torque"},
    ),
    "a flipped axis": (
        'name="lift" axis="0 1 0"',
        'name="lift" axis="0 -1 0"',
        {"center_of_mass", "gravity_torque", "gravity_force"},
    ),
    "gravity": (
        '<option timestep="0.001"/>',
        '<option timestep="0.001" gravity="0 0 -9.8"/>',
        {"gravity_torque", "gravity_force"},
    ),
    "grams for kilograms": (
        'size="0.03" mass="0.8"',
        'size="0.03" mass="800"',
        {"mass", "center_of_mass", "gravity_torque"},
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_changed_mass_or_axis_fails_the_affected_measures(tmp_path: Path, fault: str) -> None:
    old, new, names = FAULTS[fault]
    spec = record(CHECK, arm_spec(), robot(tmp_path))
    assert ARM.count(old) == 1
    faults = failed(measure(CHECK, spec, robot(tmp_path, ARM.replace(old, new))))
    assert {m.name for m in faults} == names
    assert {m.against for m in faults} == {"golden"}


def test_mass_moved_between_links_fails_the_mass_of_the_link(tmp_path: Path) -> None:
    spec = record(CHECK, arm_spec(), robot(tmp_path))
    moved = ARM.replace('0.08" mass="0.5"', '0.08" mass="0.4"').replace(
        '0.01" mass="0.1"', '0.01" mass="0.2"'
    )
    faults = failed(measure(CHECK, spec, robot(tmp_path, moved)))
    assert {m.subject for m in faults if m.name == "mass"} == {"forearm"}


def test_a_simulator_that_disagrees_with_pinocchio_fails(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    assert arm.reference.mass() > 0  # the reference is built before the model is changed
    arm.model.body_ipos[arm.model.body("forearm").id, 0] += 0.001
    faults = failed(measure(CHECK, arm_spec(), arm))
    assert {m.against for m in faults} == {"pinocchio"}
    assert {m.name for m in faults} == {"center_of_mass", "gravity_torque"}


@QUICK
@given(text=random_robots())
def test_mass_properties_of_random_robots_agree_with_pinocchio(tmp_path: Path, text: str) -> None:
    realization = robot(tmp_path, text)
    measures = measure(CHECK, from_first(CHECK, realization), realization)
    assert failed(measures) == []
    assert {m.against for m in measures} == {"pinocchio"}


def test_a_non_finite_gravity_torque_fails(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, arm_spec(), arm)
    observation = CHECK.observe(spec, arm, lambda fraction: None)
    observation.values["gravity"]["home"]["lift"] = float("nan")
    assert {m.subject for m in failed(CHECK.compare(spec, observation, None))} == {"lift at home"}


def test_a_missing_gravity_tolerance_is_refused(tmp_path: Path) -> None:
    spec = arm_spec(tolerance={"mass": "1 g", "center_of_mass": "1 mm"}, lines={"tolerance": 9})
    with pytest.raises(SpecError, match=r"spec.yaml:9: tolerance.gravity_torque: missing: the gr"):
        measure(CHECK, spec, robot(tmp_path))


def test_an_unknown_joint_is_refused_with_its_line(tmp_path: Path) -> None:
    spec = arm_spec(target={"joints": ["elbo"]}, lines={"target.joints.0": 3})
    with pytest.raises(SpecError, match=r"spec.yaml:3: target.joints.0: .*did you mean 'elbow'"):
        measure(CHECK, spec, robot(tmp_path))


def test_mass_properties_depend_on_inertias_gravity_and_poses_only(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    parts = set(CHECK.depends(arm_spec(), arm.structure))
    assert parts <= set(arm.parts)
    assert {"mujoco/inertia:left", "mujoco/option:gravity", "mujoco/keyframe:home"} <= parts
    assert not any("actuator" in part or "collision" in part for part in parts)


def test_the_proposed_mass_properties_golden_passes(tmp_path: Path) -> None:
    arm = robot(tmp_path)
    spec = record(CHECK, from_first(CHECK, arm), arm)
    assert failed(measure(CHECK, spec, arm)) == []
