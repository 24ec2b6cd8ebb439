"""The numpy tree, Pinocchio and MuJoCo give the same kinematics and dynamics for random robots."""

from __future__ import annotations

import tempfile
from pathlib import Path

import mujoco
import numpy as np
import pytest
from asset_robots import random_urdf
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pytest_twin.asset.loss import from_mujoco, from_pinocchio
from pytest_twin.asset.loss.description import Dynamics
from pytest_twin.formats.paths import Roots
from pytest_twin.realization import mjcf_file, urdf, urdf_spec, urdf_tree
from pytest_twin.realization.files.packages import Packages
from pytest_twin.realization.files.urdf import UrdfFiles


def assert_same_dynamics(
    first: Dynamics, second: Dynamics, q: dict[str, float], tolerance: float
) -> None:
    one, two = first.poses(q), second.poses(q)
    for frame in one:
        assert one[frame] == pytest.approx(two[frame], abs=tolerance)
    assert first.mass() == pytest.approx(second.mass(), rel=1e-12)
    assert first.center_of_mass(q) == pytest.approx(second.center_of_mass(q), abs=tolerance)
    mine = [first.joints.index(name) for name in q]
    theirs = [second.joints.index(name) for name in q]
    assert first.gravity_torque(q)[mine] == pytest.approx(
        second.gravity_torque(q)[theirs], abs=100 * tolerance
    )
    assert first.mass_matrix(q)[np.ix_(mine, mine)] == pytest.approx(
        second.mass_matrix(q)[np.ix_(theirs, theirs)], abs=100 * tolerance
    )


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(text=random_urdf(), seed=st.integers(0, 2**20))
def test_tree_pinocchio_and_written_mjcf_agree(text: str, seed: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "random.urdf"
        path.write_text(text)
        robot = urdf.read(path)
        tree = urdf_tree.build(robot)
        generator = np.random.default_rng(seed)
        q = {name: float(generator.uniform(-1, 1)) for name in tree.joints}
        assert_same_dynamics(tree, from_pinocchio.reference(robot), q, 1e-10)
        spec = urdf_spec.convert(robot, UrdfFiles(Roots(path.parent), Packages())).spec
        model = mjcf_file.write(spec, path.with_suffix(".xml"), {})
        assert_same_dynamics(tree, from_mujoco.MujocoDynamics(model, robot.root), q, 1e-10)


def test_written_mjcf_has_the_values_of_the_compiled_spec_in_full_precision(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(
        '<robot name="r"><link name="a"/>'
        '<link name="b"><inertial><origin xyz="0.1 0.123456789012 0" '
        'rpy="0.3 0.2 0.1"/><mass value="1.0000000001"/><inertia ixx="0.3" iyy="0.2" izz="0.15"/>'
        '</inertial></link><joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
        '<origin xyz="0.333333333333333 0 0" rpy="1 2 3"/><axis xyz="1 2 3"/>'
        '<limit lower="-1.23456789012345" upper="1.1" effort="7.77777777" velocity="1"/>'
        '<dynamics damping="0.123456789" friction="0.0123456789"/></joint></robot>'
    )
    converted = urdf_spec.convert(urdf.read(path), UrdfFiles(Roots(tmp_path), Packages()))
    loaded = mjcf_file.write(converted.spec, tmp_path / "arm.xml", {})
    compiled = converted.spec.compile()
    for field in (
        "body_pos", "body_quat", "body_ipos", "body_iquat", "body_inertia", "body_mass",
        "jnt_axis", "jnt_range", "dof_damping", "dof_frictionloss", "actuator_forcerange",
        "actuator_ctrlrange", "jnt_actfrcrange",
    ):  # fmt: skip
        assert np.abs(getattr(loaded, field) - getattr(compiled, field)).max() <= 1e-15, field
    assert mujoco.mj_id2name(loaded, mujoco.mjtObj.mjOBJ_JOINT, 0) == "j"
