"""Parts on which a kinematic chain, a load, the dynamics and a contact depend."""

from __future__ import annotations

import json
from typing import Any

import mujoco
import pytest

from pytest_twin.dependency import Structure
from pytest_twin.realization.features.reading import model_parts, model_structure

TWO_ARMS = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" contype="1" conaffinity="1"/>
    <body name="left_base" pos="0 0 1">
      <body name="left_upper"><joint name="left_a"/><geom name="lu" size="0.1"/>
        <body name="left_lower" pos="0 0 1"><joint name="left_b"/><geom size="0.1"/>
          <site name="left_tip"/></body></body>
    %(between)s
      <body name="right_upper" pos="1 0 0"><joint name="right_a"/>
        <geom name="ru" size="0.1" %(right)s/>
        <body name="right_lower" pos="0 0 1"><joint name="right_b"/>
          <geom size="0.1" %(right)s/></body></body>
    </body>
    <body name="box" pos="3 0 0"><freejoint name="loose"/><geom size="0.1" %(box)s/></body>
  </worldbody>
  %(more)s
  <actuator><motor name="m" joint="right_a"/></actuator>
</mujoco>
"""
APART = {
    "between": '</body><body name="right_base" pos="2 0 1">',
    "right": 'contype="0" conaffinity="0"',
    "box": 'contype="0" conaffinity="0"',
    "more": "",
}


def structure(**changes: str) -> Structure:
    model = mujoco.MjModel.from_xml_string(TWO_ARMS % {**APART, **changes})
    return model_structure(model, "m", model_parts(model, "m"))


def short(ids: frozenset[str], layer: str) -> set[str]:
    prefix = f"m/{layer}:"
    return {ident.removeprefix(prefix) for ident in ids if ident.startswith(prefix)}


def test_the_dynamics_of_an_arm_do_not_depend_on_an_uncoupled_arm() -> None:
    felt = structure().dynamics(["right_b"])
    assert short(felt, "inertia") == {"right_base", "right_upper", "right_lower"}
    assert short(felt, "joint") == {"right_a", "right_b"}
    assert short(felt, "kinematics") == {"right_base", "right_upper", "right_lower"}
    assert short(felt, "actuator") == {"m"}
    assert short(felt, "option") == {"gravity", "integration"}
    assert short(felt, "collision") == set()


LINKS = {
    "common base": {"between": ""},
    "contact": {"right": 'contype="1" conaffinity="1"'},
    "one-sided masks": {"right": 'contype="0" conaffinity="1"'},
    "pair": {"more": '<contact><pair geom1="lu" geom2="ru"/></contact>'},
    "joint equality": {
        "more": '<equality><joint joint1="left_a" joint2="right_b"/></equality>',
    },
    "weld": {"more": '<equality><weld body1="left_lower" body2="right_upper"/></equality>'},
    "tendon": {
        "more": '<tendon><fixed><joint joint="left_b" coef="1"/><joint joint="right_b" coef="1"/>'
        "</fixed></tendon>"
    },
}


@pytest.mark.parametrize("change", LINKS.values(), ids=LINKS.keys())
def test_the_dynamics_of_coupled_trees_depend_on_each_other(change: dict[str, str]) -> None:
    found = structure(**change)
    felt = found.dynamics(["right_a"])
    arms = {"left_upper", "left_lower", "right_upper", "right_lower"}
    assert arms <= short(felt, "inertia")


def test_the_dynamics_depend_on_the_whole_model_if_contact_is_possible() -> None:
    # The left arm may touch the floor; the right arm has no collisions.
    both = structure()
    assert both.dynamics(["left_a"]) == both.dynamics()
    assert "world" in short(both.dynamics(["left_a"]), "collision")
    assert "world" not in short(both.dynamics(["right_a"]), "collision")
    alone = structure(right='contype="2" conaffinity="0"')
    assert "left_upper" not in short(alone.dynamics(["right_a"]), "inertia")
    itself = structure(right='contype="2" conaffinity="2"')
    assert "left_upper" in short(itself.dynamics(["right_a"]), "inertia")


def test_the_chain_of_a_frame_contains_all_bodies_up_to_the_world() -> None:
    chain = structure().chain(["left_tip"])
    assert chain == {
        "m/frame:left_tip",
        *(f"m/kinematics:{body}" for body in ("left_base", "left_upper", "left_lower")),
    }
    assert structure().chain(["world"]) == frozenset()


def test_a_chain_includes_mimic_couplings_and_closed_loops() -> None:
    mimic = structure(**LINKS["joint equality"]).chain(["left_tip"])
    assert "right_lower" in short(mimic, "kinematics")
    assert short(mimic, "coupling") == {"equality#0"}
    tied = '<equality><weld body1="box" body2="right_upper"/></equality>'
    loop = structure(more=tied).chain(["left_tip"])
    assert {"box", "right_upper"} <= short(loop, "kinematics")
    assert short(loop, "coupling") == {"equality#0"}


def test_the_load_of_a_joint_consists_of_the_bodies_it_carries() -> None:
    load = structure().carried(["left_a"])
    assert short(load, "inertia") == {"left_upper", "left_lower"}
    assert short(load, "kinematics") == {"left_base", "left_upper", "left_lower"}


def test_unknown_names_become_dependencies_on_missing_parts() -> None:
    found = structure()
    for ids in (
        found.chain(["nowhere"]),
        found.carried(["nothing"]),
        found.dynamics(["nothing"]),
        found.contact(["nobody"]),
        found.limits(["nothing"]),
        found.keyframe("never"),
    ):
        assert ids - found.part_ids


def test_a_structure_survives_conversion_to_json_and_back() -> None:
    found = structure(**LINKS["weld"])
    assert Structure.from_json(json.loads(json.dumps(found.to_json()))) == found


DAMAGE: list[tuple[str, Any]] = [
    ("part_ids", "all"),
    ("body_parent", ["torso"]),
    ("body_parent", {"torso": 1}),
    ("contact_masks", {"torso": [1]}),
    ("contact_masks", {"torso": [1, "2"]}),
    ("couplings", {"m/coupling:x": "torso"}),
    ("joint_range", {"left_a": [0, True]}),
    ("extra", 1),
    ("realization", None),
]


@pytest.mark.parametrize(("key", "value"), DAMAGE)
def test_invalid_json_of_a_structure_is_refused(key: str, value: object) -> None:
    data = {**json.loads(json.dumps(structure().to_json())), key: value}
    with pytest.raises(ValueError, match=rf"^{key}[.:]|not the fields of a structure"):
        Structure.from_json(data)
