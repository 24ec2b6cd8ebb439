"""Each property holds on correct robots and fails on the fault that it detects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.properties import PROPERTIES, Asset, Form, PropertyError, Tolerances
from pytest_twin.properties.asset import load_asset
from pytest_twin.properties.form import realization_form, reference_form
from pytest_twin.properties.trees import leaves, mirror, reroot, tree_of, urdf_text
from pytest_twin.realization import load, usd
from pytest_twin.strategies import DrawnRobot, perturbed_assets, robots

DEMO = Path(__file__).resolve().parents[2] / "golden"
ARM = """<robot name="arm">
  <link name="base"><inertial><mass value="3"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="upper"><inertial><origin xyz="0.1 0.02 0" rpy="0.2 0 0.3"/><mass value="2"/>
      <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.001" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.1 0.08"/></geometry></collision>
  </link>
  <link name="lower"><inertial><origin xyz="0.05 0.01 0"/><mass value="1"/>
      <inertia ixx="0.01" iyy="0.012" izz="0.011" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="jaw"><inertial><origin xyz="0.01 0 0.02"/><mass value="0.2"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="1.5e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0.1 -0.2 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" effort="40" velocity="3"/><dynamics damping="0.7" friction="0.2"/>
  </joint>
  <joint name="elbow" type="prismatic"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.2 0 0" rpy="0 0 1"/><axis xyz="0.6 0 0.8"/>
    <limit lower="0" upper="0.4" effort="100" velocity="0.5"/></joint>
  <joint name="grip" type="revolute"><parent link="lower"/><child link="jaw"/>
    <origin xyz="0 0.1 0"/><axis xyz="1 0 0"/><mimic joint="elbow" multiplier="2" offset="0.1"/>
    <limit lower="0" upper="1" effort="5" velocity="1"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/>
    <origin xyz="0 0 0.1" rpy="0 1.5707963267948966 0"/></joint>
</robot>
"""


def asset_of(folder: Path, text: str = ARM, *, with_usd: bool = False) -> Asset:
    path = folder / "arm.urdf"
    path.write_text(text)
    return load_asset(path, usd=with_usd)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return asset_of(tmp_path_factory.mktemp("arm"))


@pytest.mark.parametrize("name", PROPERTIES)
def test_every_property_holds_on_a_correct_arm(name: str, arm: Asset) -> None:
    PROPERTIES[name].hold(arm)


def test_every_property_holds_on_the_demo_twin_and_its_usd() -> None:
    for source in ("twin.yaml", "arm.urdf"):
        asset = load_asset(DEMO / source)
        for made in PROPERTIES.values():
            made.hold(asset)
        # With the package extra a URDF is also tested as a USD stage.
        if source == "arm.urdf":
            names = [form.name for form in asset.forms]
            assert ("USD" in names) != any("USD is left out" in words for words in asset.left_out)


@pytest.mark.parametrize("name", ["panda.urdf", "bolt.urdf", "iris.urdf", "double_pendulum.urdf"])
def test_every_property_holds_on_real_robot_descriptions(name: str) -> None:
    try:
        files = distribution("example-robot-data").files or []
    except PackageNotFoundError:
        pytest.skip("example-robot-data is not installed")
    path = next(Path(str(file.locate())) for file in files if str(file).endswith(f"/{name}"))
    asset = load_asset(path, usd=False)
    for made in PROPERTIES.values():
        made.hold(asset)


@settings(
    max_examples=6,
    deadline=None,
    derandomize=True,
    phases=(Phase.generate,),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(robot=robots(links=(3, 7)))
def test_every_property_holds_on_random_robots(robot: DrawnRobot, tmp_path: Path) -> None:
    asset = load_asset(robot.write(tmp_path), usd=False)
    for made in PROPERTIES.values():
        made.hold(asset)


@settings(
    max_examples=4,
    deadline=None,
    derandomize=True,
    phases=(Phase.generate,),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_every_property_holds_on_perturbed_assets(data: st.DataObject, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(ARM)
    other = data.draw(perturbed_assets(tmp_path / "arm.urdf")).realization
    forms = [
        realization_form(other, "MuJoCo", complete=True),
        reference_form(other, "Pinocchio", complete=True),
    ]
    asset = Asset("perturbed arm", forms)
    for made in PROPERTIES.values():
        made.hold(asset)


# -- each property fails and states where and by how much


def faulty(folder: Path, old: str, new: str, target: str = "MuJoCo") -> Asset:
    """The arm with one realization made from an edited description."""
    right = asset_of(folder)
    assert old in ARM
    wrong = asset_of(folder, ARM.replace(old, new, 1))
    swapped = {form.name: form for form in wrong.forms}[target]
    return Asset("arm", [swapped if f.name == target else f for f in right.forms])


FAULTS: list[tuple[str, str, str, str, str]] = [
    (
        "joint_direction",
        '<axis xyz="0 1 0"/>',
        '<axis xyz="0 -1 0"/>',
        "MuJoCo",
        "joint 'shoulder': moves in the opposite direction by 3.142 rad .*, MuJoCo against URDF",
    ),
    (
        "forward_kinematics",
        'xyz="0.2 0 0" rpy="0 0 1"',
        'xyz="0.2 0 0.0005" rpy="0 0 1"',
        "Pinocchio",
        r"frame '\w+': has another position by 0.0005 m \(tolerance 1e-06 m\), Pinocchio against "
        "URDF",
    ),
    (
        "mass_matrix",
        'ixx="0.01" iyy="0.012"',
        'ixx="0.01" iyy="0.013"',
        "Pinocchio",
        "joint 'shoulder': has another inertia by 0.00.* kg[*]m",
    ),
    (
        "gravity_torque",
        'xyz="0.05 0.01 0"',
        'xyz="0.06 0.01 0"',
        "Pinocchio",
        "has another gravity torque by .* N[*]m",
    ),
    (
        "center_of_mass",
        '<mass value="1"/>',
        '<mass value="1.01"/>',
        "MuJoCo",
        "the robot: weighs 6.21 kg, not 6.2 kg, off by 0.01 kg",
    ),
    (
        "link_inertias",
        'ixx="1e-4"',
        'ixx="1.2e-4"',
        "MuJoCo",
        "link 'jaw': has another inertia about its centre of mass by 2e-05 kg[*]m",
    ),
    (
        "limits",
        'lower="-1" upper="2"',
        'lower="-1" upper="2.5"',
        "MuJoCo",
        "joint 'shoulder': has 2.5, not 2 rad, as upper end of its range, off by 0.5 rad",
    ),
    (
        "limits",
        'type="revolute"><parent link="base"/>',
        'type="continuous"><parent link="base"/>',
        "Pinocchio",
        r"joint 'shoulder': has no range, and should have \(-1 to 2 rad\)",
    ),
    (
        "limits",
        'effort="40"',
        'effort="0"',
        "MuJoCo",
        r"joint 'shoulder': has no effort, and should have \(40 N[*]m\)",
    ),
    (
        "passive_terms",
        'damping="0.7"',
        'damping="0"',
        "Pinocchio",
        "joint 'shoulder': has 0, not 0.7 N[*]m[*]s/rad, as damping, off by 0.7",
    ),
    (
        "couplings",
        '<mimic joint="elbow" multiplier="2" offset="0.1"/>',
        "",
        "MuJoCo",
        "joint 'grip': no longer follows 'elbow', MuJoCo against URDF",
    ),
    (
        "couplings",
        'multiplier="2"',
        'multiplier="-2"',
        "MuJoCo",
        "joint 'grip': follows with another ratio by 4",
    ),
    (
        "collision_shapes",
        "0.2 0.1 0.08",
        "200 100 80",
        "Pinocchio",
        "link 'upper': has a box, 200 x 100 x 80 m .* in place of a box, 0.2 x 0.1 x 0.08 m",
    ),
    (
        "joints_and_frames",
        'name="shoulder" type="revolute"',
        'name="shoulder" type="fixed"',
        "MuJoCo",
        "joint 'shoulder': is missing, MuJoCo against URDF",
    ),
]


@pytest.mark.parametrize(("name", "old", "new", "target", "words"), FAULTS)
def test_each_property_detects_its_fault(
    name: str, old: str, new: str, target: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(PropertyError, match=words):
        PROPERTIES[name].hold(faulty(tmp_path, old, new, target))


class _Changed:
    """Dynamics in which one result is modified."""

    def __init__(self, dynamics: Any, **answers: Callable[[Any], Any]) -> None:
        self._dynamics, self._answers = dynamics, answers

    def __getattr__(self, name: str) -> Any:
        held = getattr(self._dynamics, name)
        if name not in self._answers:
            return held
        return lambda q: self._answers[name](held(q))


def _with_changed_mujoco(asset: Asset, change: Callable[[Form], Form]) -> Asset:
    return Asset("arm", [change(f) if f.name == "MuJoCo" else f for f in asset.forms])


def _dynamics(**answers: Callable[[Any], Any]) -> Callable[[Form], Form]:
    def change(form: Form) -> Form:
        dynamics = _Changed(form.description.dynamics, **answers)
        described = dataclasses.replace(form.description, dynamics=dynamics)  # type: ignore[arg-type]
        return dataclasses.replace(form, description=described)

    return change


def _impossible(form: Form) -> Form:
    links = dict(form.description.links)
    links["jaw"] = dataclasses.replace(links["jaw"], inertia=np.diag([1.0, 0.1, 0.1]))
    described = dataclasses.replace(form.description, links=links)
    return dataclasses.replace(form, description=described)


MECHANICS: list[tuple[str, Callable[[Form], Form], str]] = [
    ("possible_inertias", _impossible, "link 'jaw': a principal moment exceeds .* by 0.4"),
    (
        "positive_definite_mass_matrix",
        _dynamics(mass_matrix=lambda m: m - 0.9 * np.diag(np.diag(m))),
        "negative eigenvalue",
    ),
    (
        "positive_definite_mass_matrix",
        _dynamics(mass_matrix=lambda m: m + 1e-3 * np.triu(np.ones_like(m), 1)),
        "is not symmetric",
    ),
    ("kinetic_energy", _dynamics(mass_matrix=lambda m: 1.001 * m), "by its mass matrix and"),
    ("gravity_is_gradient", _dynamics(gravity_torque=lambda t: -t), "gravity torque .* is not dV"),
    (
        "coriolis_forces",
        _dynamics(mass_matrix=lambda m: np.sqrt(np.abs(m)) * np.sign(m)),
        "Coriolis and centrifugal force",
    ),
]


@pytest.mark.parametrize(("name", "change", "words"), MECHANICS)
def test_properties_detect_physically_impossible_dynamics(
    name: str, change: Callable[[Form], Form], words: str, arm: Asset
) -> None:
    with pytest.raises(PropertyError, match=words):
        PROPERTIES[name].hold(_with_changed_mujoco(arm, change))


def test_energy_conservation_detects_a_dissipative_force(arm: Asset) -> None:
    def drag(model: Any, data: Any) -> None:
        data.qfrc_passive[:] -= 0.05 * data.qvel

    mujoco.set_mjcb_passive(drag)
    try:
        with pytest.raises(PropertyError, match=r"its energy changes within 0.05 s by .* J"):
            PROPERTIES["energy_conservation"].hold(arm)
    finally:
        mujoco.set_mjcb_passive(None)


@pytest.mark.parametrize(
    ("name", "transformation", "broken"),
    [
        ("mirrored", "mirror", lambda tree: tree),
        ("rerooted", "reroot", lambda tree, root: _turned(reroot(tree, root))),
    ],
    ids=["mirrored", "rerooted"],
)
def test_mirrored_and_rerooted_properties_detect_a_wrong_transformation(
    name: str,
    transformation: str,
    broken: Callable[..., Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A new asset, because imported forms are cached.
    asset = asset_of(tmp_path)
    monkeypatch.setattr(f"pytest_twin.properties.transformations.trees.{transformation}", broken)
    with pytest.raises(
        PropertyError, match=r"frame '\w+': .*(mirrored|with root 'tool'), has another orientation"
    ):
        PROPERTIES[name].hold(asset)


def _turned(tree: Any) -> Any:
    """The tree with reversed joint axes, as before the change of the root."""
    from pytest_twin.realization.tree import RigidTree

    return RigidTree(
        dataclasses.replace(body, joint=dataclasses.replace(body.joint, axis=-body.joint.axis))
        if body.joint
        else body
        for body in tree.bodies.values()
    )


def test_rerooting_keeps_the_total_mass_and_the_joint_types(tmp_path: Path) -> None:
    asset = asset_of(tmp_path)
    form = asset.simulated[0]
    tree = tree_of(form.model)
    turned = reroot(tree, leaves(tree)[-1])
    assert turned.mass() == pytest.approx(6.2)
    assert next(iter(turned.bodies)) == leaves(tree)[-1]
    text = urdf_text(mirror(turned))
    assert text.count('type="continuous"') == 2
    assert text.count('type="prismatic"') == 1


# -- use in test files


def test_asset_properties_creates_one_test_per_property(pytester: pytest.Pytester) -> None:
    pytester.path.joinpath("arm.urdf").write_text(ARM)
    pytester.makepyfile(
        """
        from pytest_twin.properties import asset_properties
        test_asset = asset_properties(
            "arm.urdf", examples=2, usd=False, leave_out=("energy_conservation",)
        )
        """
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "ignore")
    result.assert_outcomes(passed=len(PROPERTIES) - 1)


def test_a_failed_property_states_element_difference_and_pose(pytester: pytest.Pytester) -> None:
    folder = pytester.path
    folder.joinpath("arm.urdf").write_text(ARM)
    folder.joinpath("other.urdf").write_text(ARM.replace('xyz="0 0.1 0"', 'xyz="0 0.101 0"'))
    folder.joinpath("twin.yaml").write_text(
        "name: pair\nrealizations:\n  one: {file: arm.urdf}\n  two: {file: other.urdf}\n"
    )
    pytester.makepyfile(
        "from pytest_twin.properties import asset_properties\n"
        "test_twin = asset_properties('twin.yaml', examples=2)\n"
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "ignore")
    text = result.stdout.str()
    assert "pair: forward kinematics does not hold" in text
    assert (
        "frame 'jaw': has another position by 0.001 m (tolerance 1e-06 m), two against one" in text
    )
    # All other joints are zero; the offset of the mimic coupling moves the jaw.
    assert "at grip 0.1 (rad, m)" in text
    outcomes = result.parseoutcomes()
    assert 1 <= outcomes["failed"] <= 5
    assert outcomes["passed"] >= 15


def test_comparing_properties_are_skipped_for_a_single_realization(
    pytester: pytest.Pytester,
) -> None:
    folder = pytester.path
    folder.joinpath("free.xml").write_text(
        "<mujoco><worldbody><frame><body name='a'><freejoint name='f' align='true'/>"
        "<geom size='0.1'/><body name='b' pos='0 0 1'><joint name='h'/><geom size='0.1'/>"
        "</body></body></frame></worldbody></mujoco>"
    )
    pytester.makepyfile(
        "from pytest_twin.properties import asset_properties\n"
        "test_free = asset_properties('free.xml', examples=2)\n"
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-W", "ignore", "-rs")
    compared = sum(made.compares for made in PROPERTIES.values())
    result.assert_outcomes(passed=len(PROPERTIES) - compared, skipped=compared)
    result.stdout.fnmatch_lines(["*Pinocchio is left out: *no independent reference*"])


def test_tolerances_of_properties_can_be_changed(tmp_path: Path) -> None:
    asset = faulty(tmp_path, 'upper="2"', 'upper="2.001"')
    with pytest.raises(PropertyError):
        PROPERTIES["limits"].hold(asset)
    loose = Asset("arm", asset.forms, Tolerances(limit=1e-3))
    PROPERTIES["limits"].hold(loose)


def test_unknown_properties_and_unusable_assets_are_refused_with_the_reason(tmp_path: Path) -> None:
    from pytest_twin.properties import asset_properties

    with pytest.raises(SpecError, match=r"no such property \(got 'energi'; expected joints_and"):
        asset_properties("x.urdf", leave_out=("energi",))
    with pytest.raises(SpecError, match="no such file"):
        load_asset(tmp_path / "none.urdf")
    text = ARM.replace('ixx="0.01" iyy="0.012"', 'ixx="0.1" iyy="0.012"')
    words = r"arm.urdf:\d+: link 'lower'.*accept=\['inertia-repair:lower'\]"
    with pytest.raises(ModelError, match=words):
        asset_of(tmp_path, text)
    accepted = load_asset(tmp_path / "arm.urdf", usd=False, accept=["inertia-repair:lower"])
    PROPERTIES["possible_inertias"].hold(accepted)


def test_a_usd_stage_is_compared_with_the_other_realizations(tmp_path: Path) -> None:
    try:
        usd.require()
    except usd.UsdMissingError as error:
        pytest.skip(str(error))
    asset = asset_of(tmp_path, with_usd=True)
    assert [form.name for form in asset.forms] == ["URDF", "MuJoCo", "Pinocchio", "USD"]
    for made in PROPERTIES.values():
        made.hold(asset)
    (tmp_path / "other.urdf").write_text(ARM.replace('multiplier="2"', 'multiplier="2.1"'))
    usd.convert(tmp_path / "other.urdf", tmp_path / "other.usdc")
    mixed = load_asset(tmp_path / "arm.urdf", usd=tmp_path / "other.usdc")
    with pytest.raises(PropertyError, match=r"joint 'grip': follows with another ratio by 0\.1"):
        PROPERTIES["couplings"].hold(mixed)


def test_the_properties_of_an_mjcf_with_ground_and_an_ellipsoid_hold(tmp_path: Path) -> None:
    path = tmp_path / "cart.xml"
    path.write_text(
        "<mujoco><worldbody><geom type='plane' size='1 1 .1'/><body name='cart'>"
        "<joint type='slide'/>"
        "<geom type='ellipsoid' size='.1 .2 .3' mass='1'/></body></worldbody></mujoco>"
    )
    asset = load_asset(path, usd=False)
    for made in PROPERTIES.values():
        made.hold(asset)
    (shape,) = asset.forms[0].description.shapes["cart"]
    assert (shape.kind, shape.upper.tolist()) == ("ellipsoid", [0.1, 0.2, 0.3])


def test_two_joints_of_one_body_become_separate_links(tmp_path: Path) -> None:
    path = tmp_path / "two.xml"
    path.write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body name='a' pos='0 0 1' euler='0 0.3 0'>"
        "<joint name='x' type='slide' axis='1 0 0'/><joint name='y' axis='0 1 0' pos='0.1 0 0' "
        "ref='0.2'/><geom size='0.1' pos='0.3 0 0'/></body></worldbody></mujoco>"
    )
    realization = load(path)
    tree = tree_of(realization.model)
    q: Mapping[str, float] = {"x": 0.4, "y": 0.7}
    data = mujoco.MjData(realization.model)
    data.qpos[:] = realization.qpos(q)
    mujoco.mj_kinematics(realization.model, data)
    # Joint values of the tree are relative to the reference position.
    pose = tree.poses({"x": 0.4, "y": 0.5})["a"]
    assert np.allclose(pose, realization.frame_pose(data, "a"), atol=1e-12)
    for name in ("written_and_read", "mirrored", "rerooted"):
        PROPERTIES[name].hold(load_asset(path))
