"""Robots and configurations drawn by the Hypothesis strategies, with independent checks."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml
from hypothesis import HealthCheck, Phase, find, given, settings
from hypothesis import strategies as st

from pytest_twin.errors import SpecError
from pytest_twin.realization import load
from pytest_twin.strategies import (
    DrawnRobot,
    Spread,
    configurations,
    mjcf_robots,
    perturbed_assets,
    robots,
    urdf_robots,
)
from pytest_twin.twin import load_twin

FEW = settings(
    max_examples=15,
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
DEMO = Path(__file__).resolve().parents[2] / "golden"
GRIPPER = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="palm">
  <joint name="turn" axis="0 0 1"/><geom size="0.05"/>
  <body name="left"><joint name="left" type="slide" axis="1 0 0" range="-0.1 0.3"/>
    <geom size="0.01"/></body>
  <body name="right"><joint name="right" type="slide" axis="1 0 0" range="0 0.1"/>
    <geom size="0.01"/></body>
  </body></worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0.02 -0.5 0 0 0"/></equality></mujoco>"""
FOUR_BAR = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
  <body name="crank"><joint name="crank" axis="0 1 0" range="-1 1"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/>
    <body name="rod" pos="0 0 0.1"><joint name="rod" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01"/></body></body>
  <body name="rocker" pos="0.2 0 0"><joint name="rocker" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01"/></body></worldbody>
  <equality><connect body1="rod" body2="rocker" anchor="0.2 0 0"/></equality></mujoco>"""


@FEW
@given(robot=robots(), values=st.lists(st.floats(-0.2, 0.2), min_size=10, max_size=10))
def test_urdf_and_mjcf_of_a_drawn_robot_have_the_same_dynamics(
    robot: DrawnRobot, values: list[float], tmp_path: Path
) -> None:
    reference = pin.buildModelFromXML(_without_shapes(robot.urdf))
    simulated = load(robot.write(tmp_path, "mjcf"))
    data, full = mujoco.MjData(simulated.model), pin.neutral(reference)
    for joint, value in zip(simulated.joints, values, strict=False):
        data.qpos[simulated.joint_qpos_index(joint)] = value
        held = reference.joints[reference.getJointId(joint)]
        full[held.idx_q : held.idx_q + held.nq] = (
            [np.cos(value), np.sin(value)] if held.nq == 2 else [value]
        )
    mujoco.mj_forward(simulated.model, data)
    matrix = np.zeros((simulated.model.nv,) * 2)
    mujoco.mj_fullM(simulated.model, data, matrix)
    other = reference.createData()
    expected = np.triu(pin.crba(reference, other, full))
    expected = expected + np.triu(expected, 1).T
    order = [reference.joints[reference.getJointId(j)].idx_v for j in simulated.joints]
    assert np.allclose(matrix, expected[np.ix_(order, order)], rtol=1e-9, atol=1e-9)
    pin.framesForwardKinematics(reference, other, full)
    for link in robot.links:
        placed = other.oMf[reference.getFrameId(link.name, pin.FrameType.BODY)]
        assert np.allclose(data.body(link.name).xpos, placed.translation, atol=1e-12)


def _without_shapes(urdf: str) -> str:
    from lxml import etree

    root = etree.fromstring(urdf)
    for link in root.findall("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
    for joint in root.findall("joint"):
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
    return str(etree.tostring(root, encoding="unicode"))


@FEW
@given(robots(links=(3, 5), kinds=("revolute", "fixed"), branching=False, mimics=False))
def test_options_limit_links_joint_types_and_branching(robot: DrawnRobot) -> None:
    assert 3 <= len(robot.links) <= 5
    assert {joint.kind for joint in robot.joints} <= {"revolute", "fixed"}
    assert [joint.parent for joint in robot.joints] == [link.name for link in robot.links[:-1]]
    assert not any(joint.mimic for joint in robot.joints)


@FEW
@given(robots())
def test_every_moving_link_has_a_possible_inertia(robot: DrawnRobot) -> None:
    moved = {joint.child for joint in robot.joints if joint.kind != "fixed"}
    for link in robot.links:
        assert link.mass > 0 or link.name not in moved
        assert 2 * max(link.moments) <= sum(link.moments) * (1 + 1e-12)


def test_mimics_meshes_branches_massless_links_and_continuous_joints_are_drawn() -> None:
    for wanted in (
        lambda r: any(j.mimic for j in r.joints),
        lambda r: any(s.kind == "mesh" for link in r.links for s in link.shapes),
        lambda r: len({j.parent for j in r.joints}) < len(r.joints),
        lambda r: any(link.mass == 0 for link in r.links),
        lambda r: any(j.kind == "continuous" for j in r.joints),
    ):
        find(robots(), wanted, settings=settings(phases=(Phase.generate,), max_examples=2000))


@FEW
@given(urdf=urdf_robots(links=(2, 3)), mjcf=mjcf_robots(links=(2, 3)))
def test_drawn_texts_need_no_mesh_files(urdf: str, mjcf: str, tmp_path: Path) -> None:
    for name, text in (("r.urdf", urdf), ("r.xml", mjcf)):
        (tmp_path / name).write_text(text)
        assert load(tmp_path / name).joints


@FEW
@given(data=st.data(), robot=robots(links=(4, 8), meshes=False))
def test_drawn_configurations_respect_limits_and_mimic_couplings(
    data: st.DataObject, robot: DrawnRobot, tmp_path: Path
) -> None:
    q = data.draw(configurations(robot.write(tmp_path)))
    assert set(q) == {joint.name for joint in robot.joints if joint.kind != "fixed"}
    for joint in robot.joints:
        if joint.limits is not None:
            assert joint.limits[0] - 1e-9 <= q[joint.name] <= joint.limits[1] + 1e-9
        if joint.mimic is not None:
            leader, multiplier, offset = joint.mimic
            assert q[joint.name] == pytest.approx(multiplier * q[leader] + offset, abs=1e-12)


def test_a_joint_is_drawn_only_where_its_mimic_stays_within_limits(tmp_path: Path) -> None:
    # right = 0.02 - 0.5 left stays within its limits for left from -0.1 to 0.04.
    (tmp_path / "gripper.xml").write_text(GRIPPER)
    seen: list[float] = []

    @settings(FEW, max_examples=300)
    @given(configurations(tmp_path / "gripper.xml"))
    def draw(q: dict[str, float]) -> None:
        seen.append(q["left"])
        assert q["right"] == pytest.approx(0.02 - 0.5 * q["left"])
        assert abs(q["turn"]) <= np.pi

    draw()
    assert -0.1 <= min(seen) < -0.05
    assert 0.02 < max(seen) <= 0.041


def test_a_joint_value_can_be_fixed_but_not_that_of_a_mimic(tmp_path: Path) -> None:
    path = tmp_path / "gripper.xml"
    path.write_text(GRIPPER)
    q = find(configurations(path, {"left": 0.03}), lambda q: True)
    assert (q["left"], q["right"]) == (0.03, pytest.approx(0.005))
    with pytest.raises(
        SpecError, match=r"joints: not an independent joint \(got 'right'; expected left, turn"
    ):
        configurations(path, {"right": 0.0})


def test_drawn_configurations_satisfy_closed_kinematic_loops(tmp_path: Path) -> None:
    (tmp_path / "bar.xml").write_text(FOUR_BAR)
    realization = load(tmp_path / "bar.xml")

    @settings(FEW, max_examples=10)
    @given(configurations(realization))
    def draw(q: dict[str, float]) -> None:
        data = mujoco.MjData(realization.model)
        data.qpos[:] = realization.qpos(q)
        mujoco.mj_kinematics(realization.model, data)
        end = data.body("rod").xmat.reshape(3, 3) @ [0.2, 0, 0] + data.body("rod").xpos
        at = data.body("rocker").xmat.reshape(3, 3) @ [0, 0, 0.1] + data.body("rocker").xpos
        assert np.allclose(end, at, atol=1e-8)

    draw()


def test_perturbed_parameters_stay_within_the_given_spread() -> None:
    arm = load(DEMO / "arm.xml")
    spread = Spread(mass=0.1, com=1e-3, position=2e-3, damping=0.5)

    @FEW
    @given(perturbed_assets(arm, spread))
    def draw(other: object) -> None:
        model = other.realization.model  # type: ignore[attr-defined]
        assert np.all(
            np.abs(model.body_mass / np.maximum(arm.model.body_mass, 1e-9) - 1)[1:] <= 0.1 + 1e-9
        )
        assert np.abs(model.body_ipos - arm.model.body_ipos).max() <= 1e-3 + 1e-12
        assert np.abs(model.body_pos - arm.model.body_pos).max() <= 2e-3 + 1e-12
        assert len(other.changes) == _count(other.patches)  # type: ignore[attr-defined]
        reference = other.realization.reference  # type: ignore[attr-defined]
        assert reference.mass() == pytest.approx(float(model.body_mass.sum()), rel=1e-9)

    draw()


def _count(patches: dict[str, dict[str, dict[str, object]]]) -> int:
    """Number of changed parameters; an inertia scales with its mass and is not counted."""
    return sum(
        len(set(patch) - {"inertia"}) for family in patches.values() for patch in family.values()
    )


@pytest.mark.nightly
def test_perturbed_assets_shrink_to_the_one_relevant_parameter(tmp_path: Path) -> None:
    path = tmp_path / "gripper.xml"
    path.write_text(GRIPPER)
    gripper = load(path)
    assert find(perturbed_assets(gripper), lambda other: True).changes == ()
    other = find(perturbed_assets(gripper), lambda p: "left" in p.patches.get("body", {}))
    assert len(other.changes) == 1
    assert re.fullmatch(r"\w+ of body 'left': .* -> .* k?[gm]", other.changes[0])


def test_a_perturbation_can_be_applied_as_a_fit_in_the_twin_file(tmp_path: Path) -> None:
    arm = DEMO / "arm.urdf"
    generate = settings(phases=(Phase.generate,), max_examples=50)
    other = find(
        perturbed_assets(arm), lambda p: "forearm" in p.patches.get("body", {}), settings=generate
    )
    shutil.copytree(DEMO / "meshes", tmp_path / "meshes")
    shutil.copy(arm, tmp_path / "arm.urdf")
    fit = {"id": "drawn"} | {
        family: {name: _plain(patch) for name, patch in patches.items()}
        for family, patches in other.patches.items()
    }
    (tmp_path / "twin.yaml").write_text(yaml.safe_dump({"model": "arm.urdf", "fit": fit}))
    fitted = load(tmp_path / "arm.urdf", twin=load_twin(tmp_path / "twin.yaml")).model
    made, plain = other.realization.model, load(arm).model
    moved = False
    for values in ("body_mass", "body_pos", "body_ipos", "dof_damping"):
        assert np.allclose(getattr(fitted, values), getattr(made, values))
        moved |= not np.allclose(getattr(plain, values), getattr(made, values))
    assert moved


def _plain(patch: dict[str, object]) -> dict[str, object]:
    return {key: list(v) if isinstance(v, tuple) else v for key, v in patch.items()}


def test_without_hypothesis_the_error_names_the_package_extra() -> None:
    code = "import sys; sys.modules['hypothesis'] = None\nimport pytest_twin.strategies"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300
    )
    assert result.returncode != 0
    assert "pip install 'pytest-twin[properties]'" in result.stderr.splitlines()[-1]
