"""The filter of pairs equals that of MuJoCo, for spheres that all overlap."""

from __future__ import annotations

from itertools import combinations

import mujoco
import pytest

from pytest_twin.realization.collision_filter import (
    are_excluded,
    are_one_or_linked,
    have_matching_masks,
)

MODEL = """<mujoco>
  <option><flag filterparent="{flag}"/></option>
  <worldbody>
    <geom name="floor" size="0.1"/>
    <body name="pedestal">
      <geom name="pedestal" size="0.1"/>
      <body name="link">
        <joint/>
        <geom name="link" size="0.1"/>
        <body name="cover"><geom name="cover" size="0.1"/></body>
        <body name="forearm">
          <joint axis="0 1 0"/>
          <geom name="forearm" size="0.1"/>
          <body name="hand">
            <joint axis="1 0 0"/>
            <geom name="hand" size="0.1"/>
            <geom name="visual" size="0.1" contype="0" conaffinity="0"/>
            <geom name="other_layer" size="0.1" contype="2" conaffinity="2"/>
          </body>
        </body>
      </body>
    </body>
    <body name="box"><freejoint/><geom name="box" size="0.1"/></body>
    <body name="ghost">
      <freejoint/>
      <geom name="ghost" size="0.1" contype="2" conaffinity="1"/>
    </body>
  </worldbody>
  <contact><exclude body1="hand" body2="box"/><exclude body1="pedestal" body2="forearm"/></contact>
</mujoco>"""


@pytest.mark.parametrize("flag", ["enable", "disable"])
def test_the_pairs_that_are_not_kept_apart_are_those_that_mujoco_collides(flag: str) -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.format(flag=flag))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    collided = {tuple(sorted(contact.geom)) for contact in data.contact}
    body = model.geom_bodyid
    allowed = {
        (g, h)
        for g, h in combinations(range(model.ngeom), 2)
        if not are_one_or_linked(model, body[g], body[h])
        and not are_excluded(model, body[g], body[h])
        and have_matching_masks(model, g, h)
    }
    assert allowed == collided
    assert len(collided) > 10
