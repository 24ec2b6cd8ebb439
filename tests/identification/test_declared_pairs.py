"""Contact parameters of a pair that the model declares; other contacts keep their own."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pytest_twin.errors import ModelError, SpecError
from pytest_twin.identification.contact.loss import Stretch, errors_of, losses, whole_toss
from pytest_twin.identification.contact.parameters import (
    DAMPING,
    FRICTION,
    OFFSET,
    ROLLING,
    STIFFNESS,
    ContactModel,
    contact_model,
    geom_patch,
    pair_patch,
)
from pytest_twin.identification.contact.tosses import Toss
from pytest_twin.realization import Realization, load
from pytest_twin.realization.free_body import free_body
from pytest_twin.twin import load_twin

PAIR = (
    '<contact><pair name="base" geom1="faces" geom2="table" friction="0.5 0.5" CHANGES/></contact>'
)
BOX = """<mujoco model="box">
  <option timestep="0.002" cone="elliptic"/>
  <worldbody>
    <geom name="table" type="plane" size="5 5 0.1" friction="0.9"/>
    <geom name="wall" type="box" pos="0.4 0 0.1" size="0.05 1 0.1" friction="0.7"/>
    <body name="box" pos="0 0 0.05"><freejoint/>
      <geom name="faces" type="box" size="0.05 0.05 0.05" mass="0.4" friction="0.6" CONTACTS/>
    </body>
  </worldbody>
  PAIR
</mujoco>"""
TRUE = {FRICTION: 0.25, STIFFNESS: 4000.0, DAMPING: 120.0, OFFSET: 0.001}


def text(pair: str = PAIR, contacts: str = "") -> str:
    return BOX.replace("PAIR", pair).replace("CONTACTS", contacts).replace("CHANGES", "")


@pytest.fixture
def realization(tmp_path: Path) -> Realization:
    (tmp_path / "box.xml").write_text(text())
    return load(tmp_path / "box.xml")


@pytest.fixture
def contact(realization: Realization) -> ContactModel:
    return contact_model(realization, free_body(realization))


def slide(model: mujoco.MjModel, speed: float) -> Stretch:
    """Motion of the box over 0.4 s after it was pushed along the table away from the wall."""
    model.opt.timestep = 0.0005
    data = mujoco.MjData(model)
    data.qpos[2], data.qvel[0] = 0.0509, -speed
    rows = []
    for _ in range(80):
        rows.append(np.concatenate([data.qpos, data.qvel]))
        mujoco.mj_step(model, data, 10)
    table = np.array(rows)
    time = 0.005 * np.arange(len(table))
    return whole_toss(Toss("slide", Path("slide.npz"), time, table[:, :7], table[:, 7:]))


def test_a_declared_pair_starts_at_its_own_values(contact: ContactModel) -> None:
    starts = {one.name: one.start for one in contact.parameters}
    assert starts[FRICTION] == 0.5
    names = [contact.model.geom(g).name for g in (*contact.body.geoms, *contact.body.others)]
    assert names == ["faces", "table"]
    assert contact.body.pairs == (0,)


def test_only_the_declared_pair_gets_the_parameters(contact: ContactModel) -> None:
    model = contact.at({**TRUE, ROLLING: 1e-4})
    assert model.pair_friction[0] == pytest.approx([0.25, 0.25, 0.005, 1e-4, 1e-4])
    assert model.pair_dim[0] == 6
    assert model.pair_solref[0, 0] < 0.0
    for name in ("geom_friction", "geom_solref", "geom_priority", "geom_condim"):
        assert (getattr(model, name) == getattr(contact.model, name)).all(), name
    faces = model.geom("faces").id
    assert model.geom_size[faces] == pytest.approx([0.051] * 3)


def test_the_true_friction_of_the_pair_predicts_slides_best(contact: ContactModel) -> None:
    rows = [slide(contact.at(TRUE), speed) for speed in (0.4, 0.8)]
    models = [contact.at({**TRUE, FRICTION: value}) for value in (0.15, 0.25, 0.4)]
    low, true, high = (
        losses(one, contact.size).mean() for one in errors_of(models, contact.body, rows)
    )
    assert true < 0.2 * low
    assert true < 0.2 * high


def test_geoms_that_collide_in_a_declared_pair_only_are_found(tmp_path: Path) -> None:
    alone = 'contype="0" conaffinity="0"'
    (tmp_path / "box.xml").write_text(text(contacts=alone))
    assert free_body(load(tmp_path / "box.xml")).pairs == (0,)
    (tmp_path / "none.xml").write_text(text("", alone))
    with pytest.raises(ModelError, match="or a pair of them under <contact>"):
        free_body(load(tmp_path / "none.xml"))


def test_without_a_declared_pair_the_geom_of_the_object_decides(tmp_path: Path) -> None:
    (tmp_path / "box.xml").write_text(text(""))
    realization = load(tmp_path / "box.xml")
    contact = contact_model(realization, free_body(realization))
    assert contact.body.pairs == ()
    model = contact.at(TRUE)
    faces = model.geom("faces").id
    assert model.geom_friction[faces, 0] == 0.25
    assert model.geom_priority[faces] == 1


def test_a_twin_applies_the_fit_of_a_pair(
    realization: Realization, contact: ContactModel, tmp_path: Path
) -> None:
    faces = contact.body.geoms[0]
    fit = {
        "geom": {"faces": geom_patch(contact.model, contact.body, faces, TRUE)},
        "pair": {"base": pair_patch(contact.model, 0, TRUE)},
    }
    assert list(fit["geom"]["faces"]) == ["size"]
    (tmp_path / "twin.yaml").write_text(f"model: box.xml\nfit: {json.dumps({'id': 'x', **fit})}\n")
    twin = load_twin(tmp_path / "twin.yaml")
    laid = load(twin.first_realization.file, twin=twin).model
    expected = contact.at(TRUE)
    for name in ("pair_friction", "pair_solref", "geom_friction", "geom_size"):
        assert getattr(laid, name) == pytest.approx(getattr(expected, name)), name
    parts = load(twin.first_realization.file, twin=twin).parts
    changed = {name for name, part in parts.items() if part != realization.parts.get(name)}
    assert "mujoco/contact:pairs" in changed
    # The surface is farther out by 1 mm; the mass stays what it was.
    assert "mujoco/inertia:box" not in changed
    assert laid.body_inertia[1] == pytest.approx(contact.model.body_inertia[1])


def test_a_fit_of_an_unknown_pair_is_refused(realization: Realization, tmp_path: Path) -> None:
    (tmp_path / "twin.yaml").write_text(
        "model: box.xml\nfit: {id: x, pair: {bass: {friction: [0.2, 0.2]}}}\n"
    )
    twin = load_twin(tmp_path / "twin.yaml")
    with pytest.raises(SpecError, match=r"pair\.bass: the model has no such contact pair"):
        load(twin.first_realization.file, twin=twin)
