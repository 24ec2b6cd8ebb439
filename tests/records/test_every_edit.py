"""For random twins: an edit makes something stale, or it provably changes no prediction.

The predictions are computed from the files, without the dependency map: motion of the model alone
and with its records, under each condition that a golden or a record uses, and poses of the tool.
"""

from __future__ import annotations

import csv
import re
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from lxml import etree
from recorded_cell import MODEL, changed, write_cell

from pytest_twin.errors import TwinError
from pytest_twin.realization import load
from pytest_twin.realization.encoders import Encoders
from pytest_twin.realization.record_inputs import replaced_parts, states_of_records
from pytest_twin.records.state import with_records
from pytest_twin.staleness import DependencyMap, Model, staleness
from pytest_twin.twin import load_twin

sys.path.append(str(Path(__file__).parents[1] / "dependency"))

from dependency_map_of import dependency_map_of, proven

GOLDENS = {
    "fk": "kind: fk\ntarget: {frames: [tcp]}\nstimulus: {poses: [reference]}\n"
    "tolerance: {position: 1 um, orientation: 1e-6 rad}\n",
    "fall": "kind: settling\nstimulus: {duration: 1 s}\ntolerance: {angle: 1 mrad}\n",
    "replay": "kind: replay\ntarget: {recording: one.csv, controller: soft, payload: kg05}\n"
    "tolerance: {angle_rms: 1 mrad}\n",
}
VARIANTS = ({}, {"controller": "soft", "payload": "kg05"})
NUMBER = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?")

Edit = Callable[[Path, Callable[[list[Any]], Any], float], None]


# -- edits: `pick` chooses one of a list, `factor` is how much a number changes


def edit_asset(root: Path, pick: Callable[[list[Any]], Any], factor: float) -> None:
    path = root / "arm.xml"
    tree = etree.parse(path)
    places = [
        (element, name)
        for element in tree.iter(etree.Element)
        for name, value in element.attrib.items()
        if all(NUMBER.fullmatch(word) for word in value.split())
    ]
    element, name = pick(places)
    words = element.get(name).split()
    at = pick(list(range(len(words))))
    words[at] = changed_number(float(words[at]), factor)
    element.set(name, " ".join(words))
    tree.write(path)


def edit_twin(root: Path, pick: Callable[[list[Any]], Any], factor: float) -> None:
    path = root / "twin.yaml"
    data = yaml.safe_load(path.read_text())
    leaves: list[tuple[Any, Any]] = []

    def collect(node: Any) -> None:
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            if isinstance(value, dict | list):
                collect(value)
            elif isinstance(value, int | float):
                leaves.append((node, key))

    for name in ("controllers", "payloads", "calibration", "fit"):
        collect(data[name])
    node, key = pick(leaves)
    node[key] = -node[key] if key == "sign" else float(changed_number(node[key], factor))
    path.write_text(yaml.safe_dump(data))


def edit_observations(root: Path, pick: Callable[[list[Any]], Any], factor: float) -> None:
    path = root / pick(["observations.csv", "one.csv"])
    rows = list(csv.reader(path.read_text().splitlines()))
    row = pick(rows[1:])
    at = pick(list(range(1, len(row))))
    row[at] = changed_number(float(row[at]), factor)
    path.write_text("\n".join(",".join(row) for row in rows) + "\n")


def edit_plan(root: Path, pick: Callable[[list[Any]], Any], factor: float) -> None:
    line = pick(
        [
            f"hold_out: {{fraction: {0.1 * factor:.3f}}}",
            f"accept: {{translation: {0.01 * factor:.5f}}}",
            f"priors: {{joint_zeros: {0.1 * factor:.5f}}}",
        ]
    )
    with (root / "plan.yaml").open("a") as stream:
        stream.write(line + "\n")


def changed_number(value: float, factor: float) -> str:
    return f"{value * factor if value else 0.01 * factor:.9g}"


EDITS: list[Edit] = [edit_asset, edit_asset, edit_twin, edit_observations, edit_plan]


# -- what is compared


def dependencies(root: Path) -> DependencyMap:
    twin = load_twin(root / "twin.yaml")
    model = load(twin.first_realization.file, twin=twin)
    states = states_of_records(twin)
    models = {"mujoco": Model(model.parts, model.structure, replaced_parts(model))}
    return with_records(dependency_map_of(root), states, models)


def predictions(root: Path) -> list[Any]:
    """All that the twin, or its records made again, would predict."""
    twin = load_twin(root / "twin.yaml")
    found: list[Any] = []
    for with_fits in (twin, twin.before_fit("identified"), replace(twin, fit=None)):
        robot = load(twin.first_realization.file, twin=with_fits)
        for names in VARIANTS:
            found.append(motion(robot.variant(**names).model))
        joints = dict(twin.calibration.joints if with_fits is twin else twin.stated.joints)
        encoders = Encoders.of(joints, robot.joints)
        found.append(tool(robot, encoders.slope * 0.3 + encoders.offset))
    for name in ("observations.csv", "one.csv"):
        found.append(list(csv.reader((root / name).read_text().splitlines())))
    found.append(yaml.safe_load((root / "plan.yaml").read_text()))
    return found


def motion(model: mujoco.MjModel) -> list[Any]:
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.5
    data.qvel[:] = 0.7
    mujoco.mj_step(model, data, 60)
    return [data.time, *data.qpos.tolist(), *data.qvel.tolist()]


def tool(robot: Any, position: np.ndarray) -> list[float]:
    data = mujoco.MjData(robot.model)
    data.qpos[:] = position
    mujoco.mj_kinematics(robot.model, data)
    return robot.frame_pose(data, "tcp").ravel().tolist()


def random_model(numbers: list[float]) -> str:
    upper, fore, length, gain = numbers
    return (
        MODEL.replace('mass="1.2"', f'mass="{upper:.4g}"')
        .replace('mass="0.6"', f'mass="{fore:.4g}"')
        .replace('pos="0.3 0 0"', f'pos="{length:.4g} 0 0"')
        .replace('kp="20"', f'kp="{gain:.4g}"')
    )


@settings(
    max_examples=40, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)  # fmt: skip
@given(
    numbers=st.tuples(st.floats(0.5, 3), st.floats(0.2, 2), st.floats(0.1, 0.6), st.floats(5, 90)),
    edit=st.sampled_from(EDITS),
    factor=st.floats(1.001, 1.5),
    data=st.data(),
)
def test_an_edit_makes_something_stale_or_changes_no_prediction(
    numbers: tuple[float, ...], edit: Edit, factor: float, data: st.DataObject
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder).resolve()
        write_cell(root, random_model(list(numbers)))
        (root / "golden").mkdir()
        for name, text in GOLDENS.items():
            (root / "golden" / f"{name}.yaml").write_text(f"schema: 1\n{text}")
        before, released = predictions(root), proven(dependencies(root))
        assert changed(root) == {}
        edit(root, lambda choices: data.draw(st.sampled_from(choices)), factor)
        try:
            after = predictions(root)
        except TwinError:
            # Refused, and so not silent.
            assume(False)
        reasons = staleness(dependencies(root), released)
        stale = [key for key, why in reasons.items() if why]
        if not stale and not changed(root):
            assert after == before
