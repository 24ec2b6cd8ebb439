"""Every field of MuJoCo's model belongs to a part, is derived, is visual, or is in ``other``."""

from __future__ import annotations

import copy
import re

import mujoco
import numpy as np
import pytest

from pytest_twin.realization.features.fields import (
    DERIVED,
    FIELDS_OF_LAYER,
    VISUAL,
    layer_of,
    model_fields,
)
from pytest_twin.realization.features.reading import model_parts, model_structure

RICH = """
<mujoco model="rich">
  <size nuser_body="1" nuser_jnt="1" nuser_geom="1" nuser_site="1" nuser_tendon="1"
        nuser_actuator="1" nuser_sensor="1" nuser_cam="1"/>
  <asset>
    <mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1  0.05 0.05 0.02"/>
    <mesh name="drawn" vertex="0 0 0  0.2 0 0  0 0.1 0  0 0 0.3"/>
    <hfield name="ground" nrow="3" ncol="3" size="1 1 0.2 0.1" elevation="0 0 0 0 1 0 0 0 0"/>
    <texture name="t" type="2d" builtin="flat" width="4" height="4" rgb1="1 0 0"/>
    <material name="m" texture="t" rgba="1 0 0 1"/>
  </asset>
  <custom>
    <numeric name="n" data="1 2 3"/><text name="t" data="hello"/>
    <tuple name="u"><element objtype="body" objname="arm" prm="0.5"/></tuple>
  </custom>
  <option density="1.2" viscosity="0.001"/>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="hills" type="hfield" hfield="ground" pos="0 0 -1"/>
    <camera name="watch" pos="1 0 1" user="3"/>
    <body name="rail" pos="0 0 1">
      <body name="arm" pos="0 0.1 0" quat="0.9 0.1 0 0.1" gravcomp="0.2" user="2">
        <joint name="turn" axis="0 1 0" range="-1 1" limited="true" damping="0.1 0.01 0.002"
          stiffness="1 0.1 0.01" frictionloss="0.05" armature="0.01" springref="0.2"
          actuatorfrcrange="-3 3" actuatorfrclimited="true" margin="0.01" ref="0.1" user="1"/>
        <geom name="link" type="capsule" size="0.02 0.1" fluidshape="ellipsoid" user="5"
          friction="0.9 0.01 0.002" margin="0.002" gap="0.001" solmix="0.8" material="m"/>
        <geom name="shell" type="mesh" mesh="drawn" contype="0" conaffinity="0" rgba="0 1 0 1"/>
        <geom name="wrap" type="sphere" size="0.03" pos="0 0 0.05" contype="0" conaffinity="0"/>
        <site name="tip" pos="0 0 0.2" size="0.02" user="4"/>
        <site name="side" pos="0.1 0 0.05"/>
        <body name="slider" pos="0 0 0.2">
          <joint name="slide" type="slide" axis="1 0 0" range="0 0.1" limited="true"
            actuatorgravcomp="true"/>
          <geom name="wedge" type="mesh" mesh="wedge" condim="4" priority="1"
            surfacevel="0.1 0 0 0 0 0" adhesion="0.3"/>
          <site name="far" pos="0 0 0.1"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="0.5 0 1"><joint name="wrist" type="ball" range="0 1" limited="true"/>
      <geom name="bob" size="0.05"/><site name="onball"/></body>
    <body name="free" pos="0.5 0.5 1"><freejoint name="float"/><geom name="box" type="box"
      size="0.05 0.04 0.03"/></body>
    <body name="hand" mocap="true" pos="-1 0 1"><geom name="mc" size="0.02"/></body>
    <flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.05 0.05 0.05" dim="2" radius="0.01"
      pos="-0.5 -0.5 1" mass="0.1"><edge damping="0.1"/>
      <elasticity young="1000" poisson="0.2" thickness="0.01" elastic2d="both"/></flexcomp>
  </worldbody>
  <contact>
    <pair name="p" geom1="link" geom2="box" margin="0.01" gap="0.002"
      friction="1 1 0.01 0.001 0.001"/>
    <exclude body1="ball" body2="free"/>
  </contact>
  <equality>
    <joint name="mimic" joint1="slide" joint2="turn" polycoef="0 0.1 0 0 0"/>
    <connect name="pin" body1="ball" body2="free" anchor="0 0 0.1"/>
    <weld name="glue" site1="onball" site2="tip" active="false"/>
    <tendon name="tied" tendon1="mix" tendon2="cable" active="false"/>
  </equality>
  <tendon>
    <fixed name="mix" range="-1 1" limited="true" damping="0.1" stiffness="2" frictionloss="0.1"
      armature="0.01" margin="0.01" user="7" springlength="0.01 0.02">
      <joint joint="turn" coef="1"/><joint joint="slide" coef="-2"/></fixed>
    <spatial name="cable" actuatorfrclimited="true" actuatorfrcrange="-5 5" width="0.01">
      <site site="tip"/><geom geom="wrap" sidesite="side"/><site site="far"/>
      <pulley divisor="2"/><site site="onball"/><site site="tip"/></spatial>
  </tendon>
  <actuator>
    <position name="servo" joint="turn" kp="10" kv="1" ctrlrange="-1 1" forcerange="-2 2"
      timeconst="0.02" user="1" delay="0.004" nsample="4" armature="0.01" damping="0.1"/>
    <motor name="pull" tendon="cable" gear="2" ctrlrange="-1 1" ctrllimited="true"/>
    <general name="thrust" site="tip" refsite="onball" gear="0 0 1 0 0 0" dyntype="integrator"
      actrange="-1 1" actlimited="true" group="2"/>
    <muscle name="muscle" joint="slide" lengthrange="0.01 0.2"/>
    <motor name="crank" cranksite="side" slidersite="tip" cranklength="0.3"/>
  </actuator>
  <sensor>
    <jointpos name="enc" joint="turn" noise="0.01" cutoff="3" user="1"/>
    <touch name="pad" site="tip"/>
    <framepos name="rel" objtype="site" objname="tip" reftype="body" refname="free"/>
    <distance name="gapd" geom1="link" geom2="box" cutoff="1"/>
    <rangefinder name="ray" site="tip"/>
  </sensor>
  <keyframe>
    <key name="home" time="1" qpos="%(qpos)s" ctrl="0.1 0.2 0 0 0"/>
  </keyframe>
</mujoco>
"""

# Fields that are empty in the model above.
ABSENT = {
    "oct_depth",
    "oct_child",
    "oct_aabb",
    "oct_coeff",
    "flex_node",
    "flex_node0",
    "flex_nodebodyid",
    "key_plastic",
}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    bare = re.sub(r"<keyframe>.*</keyframe>", "", RICH, flags=re.DOTALL)
    reference = mujoco.MjModel.from_xml_string(bare).qpos0
    return mujoco.MjModel.from_xml_string(RICH % {"qpos": " ".join(f"{q:.4f}" for q in reference)})


@pytest.fixture(scope="module")
def before(model: mujoco.MjModel) -> dict[str, str]:
    return digests(model)


def digests(model: mujoco.MjModel) -> dict[str, str]:
    return {ident: part.digest for ident, part in model_parts(model, "m").items()}


def test_every_field_of_the_mujoco_model_is_classified(model: mujoco.MjModel) -> None:
    fields = model_fields(model)
    assert len(fields) > 500
    claimed = {name for names in FIELDS_OF_LAYER.values() for name in names}
    assert len(claimed) == sum(len(names) for names in FIELDS_OF_LAYER.values()), (
        "a field belongs to two parts"
    )
    assert not claimed & (DERIVED | VISUAL)
    assert not DERIVED & VISUAL
    # Plugins may have any effect.
    assert {name for name in fields if layer_of(name, model) == "other"} == {
        "plugin",
        "plugin_attr",
        "plugin_attradr",
        "plugin_stateadr",
        "plugin_statenum",
        "actuator_plugin",
        "body_plugin",
        "geom_plugin",
        "sensor_plugin",
    }


def test_an_unknown_field_is_classified_as_other(model: mujoco.MjModel) -> None:
    assert layer_of("jnt_backlash", type("Newer", (), {"jnt_backlash": np.ones(3)})()) == "other"
    assert layer_of("flg_wetness", type("Newer", (), {"flg_wetness": True})()) == "other"


def test_all_classified_fields_have_values_in_the_test_model(model: mujoco.MjModel) -> None:
    empty = {
        name
        for names in FIELDS_OF_LAYER.values()
        for name in names
        if isinstance(array := getattr(model, name, None), np.ndarray) and not array.size
    }
    assert empty == {name for name in ABSENT if hasattr(model, name)}


ARRAYS = sorted(
    (layer, name)
    for layer, names in FIELDS_OF_LAYER.items()
    for name in names - ABSENT - {"opt", "stat", "nconmax", "njmax", "narena", "text_data"}
    if hasattr(mujoco.MjModel, name)
)


@pytest.mark.parametrize(("layer", "name"), ARRAYS, ids=[name for _, name in ARRAYS])
def test_changing_a_field_changes_the_digest_of_its_part(
    model: mujoco.MjModel, before: dict[str, str], layer: str, name: str
) -> None:
    size = getattr(model, name).size
    places = range(size) if size <= 24 else np.linspace(0, size - 1, 24).astype(int)
    wanted = {"mesh": ("m/mesh", "m/hfield"), "flex": ("m/flex",)}.get(layer, (f"m/{layer}",))
    moved: set[str] = set()
    for place in places:
        other = copy.copy(model)
        flat = getattr(other, name).reshape(-1)
        if flat.dtype.kind == "f":
            flat[place] += 0.125
        elif flat.dtype.kind == "b":
            flat[place] = not flat[place]
        else:
            # Another value of the same field is valid.
            values = [v for v in np.unique(flat) if v != flat[place]]
            flat[place] = values[0] if values else flat[place] ^ 1
        try:
            after = digests(other)
        except (IndexError, KeyError, ValueError):
            continue
        moved |= {i for i in before.keys() | after.keys() if before.get(i) != after.get(i)}
        if any(ident.startswith(wanted) for ident in moved):
            return
    pytest.fail(f"changed only the digests of {sorted(moved)}")


SEEN = [
    *sorted(VISUAL - {"vis", "names", "paths"}),
    *("mat_rgba", "cam_pos", "light_pos", "tex_data"),
]


@pytest.mark.parametrize("name", SEEN)
def test_changing_a_visual_field_changes_no_digest(
    model: mujoco.MjModel, before: dict[str, str], name: str
) -> None:
    other = copy.copy(model)
    flat = getattr(other, name).reshape(-1)
    flat[:] = flat ^ 1 if flat.dtype.kind in "iu" else flat == 0
    if name == "geom_rgba":
        flat[:] = 0.5
    assert digests(other) == before


@pytest.mark.parametrize(
    "name",
    [
        n
        for n in dir(mujoco.MjOption)
        if not n.startswith("_") and not callable(getattr(mujoco.MjOption, n))
    ],
)
def test_changing_any_option_changes_its_digest(
    model: mujoco.MjModel, before: dict[str, str], name: str
) -> None:
    other = copy.copy(model)
    value = getattr(other.opt, name)
    if isinstance(value, np.ndarray):
        value[-1] += 0.5
    else:
        setattr(other.opt, name, value + 1)
    moved = {ident for ident, digest in digests(other).items() if digest != before[ident]}
    assert "m/option:gravity" in moved if name == "gravity" else "m/option:integration" in moved


def test_mean_inertia_and_arena_size_belong_to_the_integration_options(
    model: mujoco.MjModel, before: dict[str, str]
) -> None:
    other = copy.copy(model)
    other.stat.meaninertia *= 100
    assert digests(other)["m/option:integration"] != before["m/option:integration"]
    small = mujoco.MjModel.from_xml_string("<mujoco><size memory='10K'/></mujoco>")
    assert "arena [bytes]" in model_parts(small, "m")["m/option:integration"].content


def test_couplings_list_the_bodies_that_they_connect(model: mujoco.MjModel) -> None:
    structure = model_structure(model, "m", model_parts(model, "m"))
    assert structure.couplings["m/coupling:mimic"] == ("arm", "slider")
    assert structure.couplings["m/coupling:pin"] == ("ball", "free")
    assert structure.couplings["m/coupling:glue"] == ("arm", "ball")
    assert structure.couplings["m/coupling:tied"] == ("arm", "ball", "slider")
    assert structure.couplings["m/coupling:cable"] == ("arm", "ball", "slider")
    assert structure.actuator_joints["servo"] == ("turn",)
    assert structure.actuator_joints["pull"] == ("turn", "slide", "wrist")
    assert structure.actuator_joints["thrust"] == ("turn", "wrist")
    assert structure.frame_body["tip"] == "arm"
    assert structure.joint_range["slide"] == (0.0, 0.1)
    assert structure.joint_range["float"] is None
    assert "hand" not in structure.body_tree
    assert structure.contact_pairs == (("arm", "free"),)
