"""Changes that twin.yaml applies to a model: fits, controllers, payloads, calibrated base."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from model_texts import ARM, PENDULUM, recordings, written
from test_reference import check_agreement

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.realization import Realization, engine, load
from pytest_twin.twin import load_twin

CONTROLLED = """model: model.xml
controllers:
  soft: {servo: {kp: 2, kv: 0.5, forcerange: [-1, 1]}}
  wrong: {serv: {kp: 2}}
  no_gain: {drive: {kp: 3}}
payloads:
  cup: {arm: {mass: 0.5, com: [0, 0, -0.3]}}
  brick: {arm: {mass: 2, com: [0.1, 0.2, -0.3], inertia: [0.1, 0.2, 0.25, 0.01, 0, 0.02]}}
  wrong: {army: {mass: 1}}
"""


def twin_of(folder: Path, text: str = CONTROLLED, model: str = PENDULUM) -> Realization:
    name = "robot.urdf" if model.startswith("<robot") else "model.xml"
    written(folder, model, name)
    twin = load_twin(written(folder, text.replace("model.xml", name), "twin.yaml"))
    return load(twin.realizations["mujoco"].file, twin=twin)


def test_a_controller_changes_only_the_stated_gains(tmp_path: Path) -> None:
    plain = twin_of(tmp_path)
    soft = plain.variant(controller="soft")
    np.testing.assert_array_equal(soft.model.actuator_gainprm[0, :3], [2, 0, 0])
    np.testing.assert_array_equal(soft.model.actuator_biasprm[0, :3], [0, -2, -0.5])
    np.testing.assert_array_equal(soft.model.actuator_forcerange[0], [-1, 1])
    np.testing.assert_array_equal(plain.model.actuator_gainprm[0, :3], [10, 0, 0])
    np.testing.assert_array_equal(soft.model.body_inertia, plain.model.body_inertia)
    assert (soft.controller, soft.payload) == ("soft", None)
    assert plain.variant() is plain


def test_the_recorded_xl330_twin_applies_the_gain_of_its_controller(tmp_path: Path) -> None:
    twin = load_twin(recordings() / "xl330/twin.yaml")
    realization = load(twin.realizations["mujoco"].file, twin=twin).variant(controller="kp800")
    assert realization.model.actuator_gainprm[0, 0] == 1.914
    assert realization.model.actuator_biasprm[0, 1] == -1.914


@pytest.mark.parametrize(
    ("kind", "patch", "gain", "bias"),
    [
        ("<velocity name='a' joint='swing' kv='3'/>", "kv: 7", [7, 0, 0], [0, 0, -7]),
        ("<damper name='a' joint='swing' kv='3' ctrlrange='0 1'/>", "kv: 7", [0, 0, -7], [0, 0, 0]),
        ("<position name='a' joint='swing' kp='3'/>", "dampratio: 1", [3, 0, 0], None),
        (
            "<intvelocity name='a' joint='swing' kp='3' actrange='-1 1'/>",
            "kp: 7",
            [7, 0, 0],
            [0, -7, 0],
        ),
        (
            "<general name='a' joint='swing' gainprm='3' biastype='affine' biasprm='0 -3 -1'/>",
            "kp: 7",
            [7, 0, 0],
            [0, -7, -1],
        ),
        ("<motor name='a' joint='swing'/>", "gear: 5", [1, 0, 0], [0, 0, 0]),
    ],
)
def test_a_changed_gain_compiles_as_if_stated_in_the_mjcf(
    tmp_path: Path, kind: str, patch: str, gain: list[float], bias: list[float] | None
) -> None:
    model = PENDULUM.replace("</actuator>", kind + "</actuator>")
    text = f"model: model.xml\ncontrollers: {{x: {{a: {{{patch}}}}}}}\n"
    patched = twin_of(tmp_path, text, model).variant(controller="x").model
    np.testing.assert_array_equal(patched.actuator_gainprm[1, :3], gain)
    if bias is not None:
        np.testing.assert_array_equal(patched.actuator_biasprm[1, :3], bias)
    attribute, value = patch.split(": ")
    head, _, tail = kind.partition(f"{attribute}='")
    stated = (
        f"{head}{attribute}='{value}'{tail.partition(chr(39))[2]}"
        if tail
        else kind.replace("/>", f" {attribute}='{value}'/>")
    )
    if "general" not in kind:
        direct = load(written(tmp_path, PENDULUM.replace("</actuator>", stated + "</actuator>")))
        for field in ("actuator_gainprm", "actuator_biasprm", "actuator_gear"):
            np.testing.assert_allclose(
                getattr(patched, field), getattr(direct.model, field), rtol=1e-14, err_msg=field
            )


@pytest.mark.parametrize(
    ("arguments", "line", "words"),
    [
        ({"controller": "sft"}, 2, "controllers: no 'sft' there (expected perhaps 'soft'"),
        ({"payload": "cap"}, 6, "payloads: no 'cap' there (expected perhaps 'cup'"),
        ({"controller": "wrong"}, 4, "no such actuator (got"),
        ({"payload": "wrong"}, 9, "no such body"),
        ({"controller": "no_gain"}, 5, "no such actuator"),
    ],
)
def test_unknown_names_are_refused_with_the_line_in_the_twin_file(
    tmp_path: Path, arguments: dict[str, str], line: int, words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        twin_of(tmp_path).variant(**arguments)
    said = str(caught.value)
    assert said.startswith(f"{tmp_path}/twin.yaml:{line}: ")
    assert words.removesuffix(" (got") in said


def test_gains_turn_a_motor_into_a_position_servo(tmp_path: Path) -> None:
    motor = "<motor name='a' joint='swing' ctrlrange='-4 4'/>"
    model = PENDULUM.replace("</actuator>", motor + "</actuator>")
    text = "model: model.xml\nfit: {id: gains, actuator: {a: {kp: 30, kv: 2}}}\n"
    made = twin_of(tmp_path, text, model).model
    np.testing.assert_array_equal(made.actuator_gainprm[1, :3], [30, 0, 0])
    np.testing.assert_array_equal(made.actuator_biasprm[1, :3], [0, -30, -2])
    np.testing.assert_array_equal(made.actuator_forcerange[1], [-4, 4])
    joint = made.joint("swing").id
    if made.jnt_limited[joint]:
        np.testing.assert_allclose(made.actuator_ctrlrange[1], made.jnt_range[joint])
    else:
        assert not made.actuator_ctrllimited[1]


def test_gains_of_a_urdf_joint_make_a_servo_with_its_range_and_effort_limit(tmp_path: Path) -> None:
    urdf = (
        "<robot name='r'><link name='base'/><link name='arm'><inertial><mass value='1'/>"
        "<inertia ixx='.01' iyy='.01' izz='.01' ixy='0' ixz='0' iyz='0'/></inertial></link>"
        "<joint name='swing' type='revolute'><parent link='base'/><child link='arm'/>"
        "<limit lower='-1' upper='2' effort='5' velocity='1'/></joint></robot>"
    )
    text = "model: model.xml\nfit: {id: gains, actuator: {swing: {kv: 2, kp: 30}}}\n"
    made = twin_of(tmp_path, text, urdf).model
    np.testing.assert_array_equal(made.actuator_biasprm[0, :3], [0, -30, -2])
    np.testing.assert_allclose(made.actuator_ctrlrange[0], [-1, 2])
    np.testing.assert_array_equal(made.actuator_forcerange[0], [-5, 5])


def test_a_position_gain_of_a_muscle_is_refused(tmp_path: Path) -> None:
    muscle = "<muscle name='drive' joint='swing' lengthrange='0 1'/>"
    model = PENDULUM.replace("</actuator>", muscle + "</actuator>")
    with pytest.raises(SpecError, match=r"controllers\.no_gain\.drive\.kp: .*no such gain"):
        twin_of(tmp_path, model=model).variant(controller="no_gain")


def test_a_payload_equals_a_welded_body(tmp_path: Path) -> None:
    """Compared with MuJoCo's fusion of two bodies, an independent computation."""
    loaded = twin_of(tmp_path).variant(payload="brick").model
    brick = (
        "<body pos='0.1 0.2 -0.3'><inertial pos='0 0 0' mass='2'"
        " fullinertia='0.1 0.2 0.25 0.01 0 0.02'/></body>"
    )
    text = PENDULUM.replace("<site", brick + "<site").replace(
        "<compiler ", "<compiler fusestatic='true' "
    )
    # MuJoCo fuses only bodies without a name.
    fused = mujoco.MjModel.from_xml_string(text)
    assert fused.nbody == 2
    assert loaded.body_mass[1] == pytest.approx(fused.body_mass[1], rel=1e-12)
    np.testing.assert_allclose(loaded.body_ipos, fused.body_ipos, atol=1e-12)
    # MuJoCo 3.11 diagonalizes an inertia with an error of 1e-7 of its largest moment.
    rtol = 1e-9 if engine._VERSION >= (3, 17) else 1e-5
    np.testing.assert_allclose(inertia_tensor(loaded), inertia_tensor(fused), rtol=rtol)


def inertia_tensor(model: mujoco.MjModel, body: int = 1) -> np.ndarray:
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[body])
    axes = axes.reshape(3, 3)
    return axes @ np.diag(model.body_inertia[body]) @ axes.T


@pytest.mark.parametrize("head", ["inertiafromgeom='true'", "settotalmass='3'"])
def test_a_payload_is_added_to_masses_derived_by_the_compiler(tmp_path: Path, head: str) -> None:
    model = PENDULUM.replace("<compiler ", f"<compiler {head} ")
    plain = twin_of(tmp_path, model=model)
    loaded = plain.variant(payload="cup")
    assert loaded.model.body_mass[1] == pytest.approx(plain.model.body_mass[1] + 0.5, rel=1e-12)
    check_agreement(loaded)


def test_controller_and_payload_can_be_combined(tmp_path: Path) -> None:
    both = twin_of(tmp_path).variant(controller="soft", payload="cup")
    assert both.model.actuator_gainprm[0, 0] == 2
    assert both.model.body_mass[1] == 1.0
    check_agreement(both)


FITTED = """model: model.xml
fit:
  id: bench
  joint: {swing: {damping: 0.3, frictionloss: 0.02, armature: 0.004, springref: 0.5,
                  stiffness: 2, range: [-1, 1.5], ref: 0.2}}
  actuator: {servo: {kp: 5}}
  body: {arm: {mass: 0.7, com: [0, 0.01, -0.1], inertia: [2.0e-4, 2.0e-4, 1.0e-4, 1.0e-5, 0, 0]}}
  geom: {rod: {friction: 0.3, solref: [0.03, 1]}}
  option: {gravity: [0, 0, -9.7], timestep: 0.001}
"""


@pytest.mark.parametrize("angle", ["radian", "degree"])
def test_a_fit_is_in_si_units_even_if_the_mjcf_uses_degrees(tmp_path: Path, angle: str) -> None:
    realization = twin_of(tmp_path, FITTED, PENDULUM.replace('"radian"', f'"{angle}"'))
    model = realization.model
    np.testing.assert_allclose(model.jnt_range, [[-1, 1.5]], rtol=1e-14)
    np.testing.assert_allclose(model.qpos0, [0.2], rtol=1e-14)
    np.testing.assert_allclose(model.qpos_spring, [0.5], rtol=1e-14)
    assert model.jnt_limited[0]
    assert (model.dof_damping[0], model.dof_frictionloss[0]) == (0.3, 0.02)
    assert (model.dof_armature[0], model.jnt_stiffness[0]) == (0.004, 2)
    assert model.actuator_gainprm[0, 0] == 5
    assert model.body_mass[1] == 0.7
    np.testing.assert_allclose(
        inertia_tensor(model),
        [[2e-4, 1e-5, 0], [1e-5, 2e-4, 0], [0, 0, 1e-4]],
        rtol=1e-12,
        atol=1e-18,
    )
    assert model.geom_friction[0, 0] == 0.3
    assert (model.opt.gravity[2], model.opt.timestep) == (-9.7, 0.001)
    check_agreement(realization)


def test_a_fit_changes_the_mujoco_model_and_the_pinocchio_reference_of_a_urdf(
    tmp_path: Path,
) -> None:
    text = (
        "model: model.xml\nfit:\n  id: bench\n"
        "  body: {upper: {mass: 3, com: [0.1, 0, 0.05]}, lower: {pos: [0.25, 0, 0]}}\n"
    )
    realization = twin_of(tmp_path, text, ARM)
    assert realization.model.body_mass.sum() == 4.0
    check_agreement(realization)
    kept = twin_of(tmp_path, text.replace(", lower: {pos: [0.25, 0, 0]}", ""), ARM)
    check_agreement(kept)


def test_a_fitted_inertia_replaces_an_impossible_one(tmp_path: Path) -> None:
    broken = ARM.replace('ixx="0.02"', 'ixx="0.2"')
    with pytest.raises(ModelError, match="no body can have"):
        twin_of(tmp_path, "model: model.xml\n", broken)
    fit = "fit: {id: repair, body: {upper: {inertia: [0.06, 0.06, 0.06]}}}\n"
    realization = twin_of(tmp_path, "model: model.xml\n" + fit, broken)
    assert not realization.source.inertia_repairs
    check_agreement(realization)


@pytest.mark.parametrize(
    ("fit", "words"),
    [
        ("joint: {swng: {damping: 1}}", "fit.joint.swng: the model has no such joint"),
        ("actuator: {swing: {kp: 1}}", "fit.actuator.swing: the model has no such actuator"),
        ("body: {rod: {mass: 1}}", "fit.body.rod: the model has no such body"),
        ("geom: {arm: {friction: 1}}", "fit.geom.arm: the model has no such geom"),
    ],
)
def test_a_fit_of_an_unknown_element_is_refused_with_its_line(
    tmp_path: Path, fit: str, words: str
) -> None:
    with pytest.raises(SpecError) as caught:
        twin_of(tmp_path, f"model: model.xml\nfit:\n  id: x\n  {fit}\n")
    assert str(caught.value).startswith(f"{tmp_path}/twin.yaml:4: {words}")


BASED = """model: model.xml
calibration: {id: c, base: {position: [1, 2, 3], quaternion: [0.8, 0, 0.6, 0]}}
"""


@pytest.mark.parametrize("model", [PENDULUM, ARM, ARM.replace('"base"', '"world"')])
def test_a_calibrated_base_has_the_calibrated_pose(tmp_path: Path, model: str) -> None:
    realization = twin_of(tmp_path, BASED, model)
    data = mujoco.MjData(realization.model)
    mujoco.mj_kinematics(realization.model, data)
    name = next(name for name in ("arm", "base", "upper") if name in realization.names("body"))
    pose = realization.frame_pose(data, name)
    np.testing.assert_allclose(pose[:3, 3], [1, 2, 3], atol=1e-15)
    np.testing.assert_allclose(pose[:3, 0], [0.28, 0, -0.96], atol=1e-15)
    check_agreement(realization)


def test_a_base_calibration_of_a_model_with_two_bases_is_refused(tmp_path: Path) -> None:
    second = "<body name='second'><joint/><geom size='.1'/></body></worldbody>"
    with pytest.raises(SpecError, match=r"calibration\.base: the model has no single base"):
        twin_of(tmp_path, BASED, PENDULUM.replace("</worldbody>", second))
