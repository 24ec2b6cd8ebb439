"""The independent reference in Pinocchio agrees with MuJoCo."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from model_texts import ARM, PENDULUM, example_robot, recordings, written
from test_mjcf_loading import binary_stl

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import Realization, engine, load

# MuJoCo 3.11 diagonalizes an inertia with an error of 1e-7 of its largest moment.
TOLERANCE = 1e-9 if engine._VERSION >= (3, 17) else 1e-7


def random_values(realization: Realization, random: np.random.Generator) -> dict[str, object]:
    values: dict[str, object] = {}
    for joint in realization.joints:
        kind = mujoco.mjtJoint(realization.model.jnt_type[realization.joint_index(joint)])
        if kind == mujoco.mjtJoint.mjJNT_BALL:
            values[joint] = unit(random.normal(size=4))
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            values[joint] = np.concatenate([random.normal(size=3), unit(random.normal(size=4))])
        else:
            values[joint] = float(random.uniform(-1.5, 1.5))
    return values


def unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def check_agreement(realization: Realization, poses: int = 3) -> None:
    """Compare mass, forward kinematics, centre of mass, gravity torque and mass matrix.

    Poses are compared in m and rotation matrix entries, torques and the mass matrix relative to
    their largest entry.
    """
    random = np.random.default_rng(7)
    model, data = realization.model, mujoco.MjData(realization.model)
    reference = realization.reference
    frames = (*realization.names("site"), *realization.names("body"))
    assert reference.mass() == pytest.approx(model.body_mass.sum(), rel=TOLERANCE, abs=1e-15)
    for index in range(poses):
        q = random_values(realization, random) if index else {}
        data.qpos[:] = realization.qpos(q)
        mujoco.mj_forward(model, data)
        for frame in frames:
            ours, theirs = realization.frame_pose(data, frame), reference.frame_pose(q, frame)
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=TOLERANCE, err_msg=frame)
        np.testing.assert_allclose(
            data.subtree_com[0], reference.center_of_mass(q), rtol=0, atol=TOLERANCE
        )
        force = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, force)
        torque = reference.gravity_torque(q)
        ours = np.concatenate([np.zeros(0), *(np.atleast_1d(torque[j]) for j in reference.joints)])
        # The torque of a joint axis through the centre of mass is only a rounding error.
        weight = 9.81 * float(model.body_mass.sum())
        scale = max(np.abs(force).max(initial=0.0), 1e-3 * weight, 1e-9)
        np.testing.assert_allclose(ours / scale, force / scale, rtol=0, atol=TOLERANCE)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        scale = max(np.abs(full).max(initial=0.0), 1e-9)
        np.testing.assert_allclose(
            reference.mass_matrix(q) / scale, full / scale, rtol=0, atol=TOLERANCE
        )


@pytest.mark.parametrize(
    "name",
    [
        "panda.urdf",
        "ur5_robot.urdf",
        "so101.urdf",
        "allegro_left_hand.urdf",
        "solo12.urdf",
        "talos_left_arm.urdf",
        "talos_full_v2.urdf",
        "double_pendulum_continuous.urdf",
    ],
)
def test_the_reference_agrees_on_urdfs_of_real_robots(name: str) -> None:
    check_agreement(load(example_robot(name), accept_invalid_inertia=True))


@pytest.mark.parametrize(
    "name", ["so101/model.xml", "so101/robot.urdf", "xl330/model.xml", "emps/model.xml"]
)
def test_the_reference_agrees_on_the_recorded_robots(name: str, tmp_path: Path) -> None:
    path = recordings() / name
    if path.suffix == ".urdf":
        # The mesh files are not available; shapes have no mass in a URDF.
        text = path.read_text()
        while "<collision>" in text:
            head, _, rest = text.partition("<collision>")
            text = head + rest.partition("</collision>")[2]
        path = written(tmp_path, text, "robot.urdf")
    check_agreement(load(path))


def test_the_reference_agrees_on_a_floating_base(tmp_path: Path) -> None:
    text = ARM.replace('"base"', '"world"').replace(
        'name="shoulder" type="revolute"', 'name="shoulder" type="floating"'
    )
    check_agreement(load(written(tmp_path, text, "arm.urdf")))


def test_mass_and_gravity_torque_of_a_pendulum_equal_the_closed_form(tmp_path: Path) -> None:
    reference = load(written(tmp_path, PENDULUM)).reference
    # m g l sin(q) with 0.5 kg and the centre of mass 0.1 m below the joint.
    expected = 0.5 * 9.81 * 0.1 * np.sin(0.4)
    assert reference.gravity_torque({"swing": 0.4})["swing"] == pytest.approx(expected, rel=1e-12)
    assert reference.mass() == 0.5
    inertia = 1e-4 + 0.5 * 0.1**2
    assert reference.mass_matrix({}) == pytest.approx(np.array([[inertia]]), rel=1e-12)


def test_the_reference_detects_a_reversed_joint_axis(tmp_path: Path) -> None:
    realization = load(written(tmp_path, ARM, "arm.urdf"))
    realization.model.jnt_axis[0] *= -1
    with pytest.raises(AssertionError, match="Not equal to tolerance"):
        check_agreement(realization)


FULL_MODEL = """<mujoco>
  <compiler angle="{angle}" eulerseq="{eulerseq}" {extra}/>
  <option gravity="0.5 -1 -9"/>
  <default>
    <geom density="700"/><joint armature="0.01"/>
    <default class="slider"><joint type="slide" axis="1 1 0" pos="0.1 0 0"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <frame pos="0.1 0.2 0.3" euler="{euler}">
      <body name="a" pos="0.1 0 0" axisangle="1 2 3 {angle_value}">
        <joint name="hinge" axis="0 1 1" pos="0.1 0.2 0" ref="{angle_value}" range="-1 1"/>
        <joint name="second" axis="1 0 0" pos="0 0 0.3"/>
        <geom type="capsule" fromto="0 0 0 0.1 0.2 0.3" size="0.05"/>
        <geom type="box" size="0.1 0.2 0.3" mass="2" pos="0.1 0 0" euler="{euler}"/>
        <site name="tip" type="capsule" fromto="0 0 0 0.1 0.1 0.3" size="0.1"/>
        <frame xyaxes="0 1 0 -1 0.5 0">
          <frame zaxis="1 0 1" pos="0 0 0.2">
            <body name="b">
              <joint name="slide" class="slider" ref="0.2"/>
              <geom type="ellipsoid" size="0.1 0.2 0.3" zaxis="0 1 -1"/>
              <geom type="cylinder" size="0.1 0.2"/>
              <geom type="mesh" mesh="tip" pos="0.1 0 0" euler="{euler}"/>
              <body name="c" pos="0 0 0.5" euler="{euler}">
                <joint name="ball" type="ball" pos="0.1 0 0.1"/>
                <inertial pos="0.1 0 0" euler="{euler}" mass="1" diaginertia="1 2 2.5"/>
                <geom type="sphere" size="0.4"/>
                <replicate count="2" offset="0.3 0 0" euler="{euler}">
                  <body pos="0 0.5 0"><joint axis="1 0 0"/>
                    <inertial pos="0 0 0.1" mass="1" fullinertia="1 2 2.5 0.1 0.2 0"/>
                    <site name="copy"/>
                  </body>
                </replicate>
              </body>
            </body>
          </frame>
        </frame>
      </body>
    </frame>
    <body name="free" pos="1 0 0" quat="1 2 0 0">
      <freejoint name="free"/><geom size="0.1"/>
      <body name="arm" pos="0 0.1 0"><joint name="wave"/><geom size="0.1" pos="0.1 0 0"/></body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.mark.parametrize("mode", ["convex", "exact"])
@pytest.mark.parametrize(
    ("angle", "eulerseq", "extra"),
    [
        ("degree", "xyz", ""),
        ("radian", "zyx", ""),
        ("radian", "XYZ", 'settotalmass="7"'),
        ("degree", "XyZ", 'inertiafromgeom="true"'),
    ],
)
def test_the_reference_agrees_on_all_mjcf_notations(
    tmp_path: Path, angle: str, eulerseq: str, extra: str, mode: str
) -> None:
    radians = np.array([0.3, -0.5, 0.7])
    values = np.rad2deg(radians) if angle == "degree" else radians
    text = FULL_MODEL.format(
        angle=angle,
        eulerseq=eulerseq,
        extra=extra,
        euler=" ".join(str(value) for value in values),
        angle_value=values[0],
    )
    (tmp_path / "tip.stl").write_bytes(binary_stl())
    mesh = f"<asset><mesh file='tip.stl' inertia='{mode}' scale='2 1 3' refpos='0 .1 0'/></asset>"
    realization = load(written(tmp_path, text.replace("<worldbody>", mesh + "<worldbody>")))
    assert realization.model.njnt == 8
    check_agreement(realization)
    assert realization.reference.notes == ()


def test_a_shape_that_the_reference_does_not_compute_is_noted(tmp_path: Path) -> None:
    text = PENDULUM.replace(
        "</mujoco>",
        "<worldbody><body name='hull'><geom name='thin' size='.1' shellinertia='true'/>"
        "</body></worldbody></mujoco>",
    )
    reference = load(written(tmp_path, text)).reference
    assert len(reference.notes) == 1
    assert "body 'hull' is MuJoCo's own: geom 'thin'" in reference.notes[0]


def test_a_planar_joint_has_no_reference_and_is_refused(tmp_path: Path) -> None:
    text = ARM.replace('name="elbow" type="prismatic"', 'name="elbow" type="planar"')
    with pytest.raises(ModelError, match="no independent reference for a planar joint"):
        load(written(tmp_path, text, "arm.urdf")).reference.mass()


def test_the_reference_refuses_unknown_names_with_similar_names(tmp_path: Path) -> None:
    reference = load(written(tmp_path, PENDULUM)).reference
    with pytest.raises(SpecError, match=r"no joint 'swin' \(expected perhaps 'swing'\)"):
        reference.gravity_torque({"swin": 0.1})
    with pytest.raises(SpecError, match=r"no frame 'top' \(expected perhaps 'tip'\)"):
        reference.frame_pose({}, "top")
    with pytest.raises(SpecError, match="not a value of joint 'swing'"):
        reference.mass_matrix({"swing": float("inf")})


numbers = st.floats(-2, 2, allow_nan=False).map(lambda value: round(value, 3))
triples = st.tuples(numbers, numbers, numbers)
axes = triples.filter(lambda axis: np.linalg.norm(axis) > 0.1)


@st.composite
def bodies(draw: st.DrawFn, depth: int = 0) -> str:
    """A random MJCF body with up to two joints, an inertia and child bodies."""
    words = lambda values: " ".join(str(value) for value in values)  # noqa: E731
    joints, before = "", np.zeros(3)
    for _ in range(draw(st.integers(0 if depth else 1, 2))):
        kind = draw(st.sampled_from(["hinge", "slide", "ball"]))
        # Two joints about one axis are redundant and make the mass matrix singular.
        axis = draw(axes)
        assume(np.linalg.norm(np.cross(axis, before)) > 0.1 or not before.any())
        before = np.array(axis)
        ref = "" if kind == "ball" else f"ref='{draw(numbers)}'"
        joints += f"<joint type='{kind}' axis='{words(axis)}' pos='{words(draw(triples))}' {ref}/>"
        if kind == "ball":
            break
    if depth == 0 and draw(st.booleans()):
        joints = "<freejoint/>"
    mass = draw(st.floats(0.1, 3).map(lambda value: round(value, 3)))
    a, b, c = (abs(value) + 0.1 for value in draw(triples))
    moments = (b * b + c * c, a * a + c * c, a * a + b * b)
    inner = "" if depth > 2 else "".join(draw(st.lists(bodies(depth + 1), max_size=2)))
    return (
        f"<body pos='{words(draw(triples))}' euler='{words(draw(triples))}'>{joints}"
        f"<inertial pos='{words(draw(triples))}' euler='{words(draw(triples))}' mass='{mass}'"
        f" diaginertia='{words(moments)}'/><site/>{inner}</body>"
    )


@settings(max_examples=60, deadline=None)
@given(trees=st.lists(bodies(), min_size=1, max_size=2))
def test_the_reference_agrees_on_random_kinematic_trees(
    tmp_path_factory: pytest.TempPathFactory, trees: list[str]
) -> None:
    text = (
        "<mujoco><compiler angle='radian'/><worldbody>" + "".join(trees) + "</worldbody></mujoco>"
    )
    for tag in ("body", "joint", "site"):
        parts = text.replace("<freejoint/>", "<joint type='free'/>").split(f"<{tag} ")
        if tag == "site":
            parts = text.split("<site/>")
            text = (
                "".join(f"{p}<site name='site{i}'/>" for i, p in enumerate(parts[:-1])) + parts[-1]
            )
            continue
        text = parts[0] + "".join(
            f"<{tag} name='{tag}{i}' {part}" for i, part in enumerate(parts[1:])
        )
    check_agreement(load(written(tmp_path_factory.mktemp("tree"), text)), poses=2)
