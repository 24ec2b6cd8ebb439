"""The events for Isaac Lab and mjlab write the drawn robots into the right places.

Neither simulator is a dependency. Stand-ins have the classes and calls that the files use, with
another order of joints and bodies than ``ranges.json``, as in a scene with several robots.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from ranges_files import ARM, covariance, make_twin, record

from pytest_twin.ranges.files import write_files
from pytest_twin.ranges.ranges_of_twin import ranges_of_file

TORCH = """
import numpy as np

float32, int = np.float32, np.int32


class Tensor(np.ndarray):
    def flatten(self, start):
        return self.reshape(*self.shape[:start], -1)

    def long(self):
        return self.astype(np.int64)

    def to(self, device):
        return self


def as_tensor(values, dtype=None, device=None):
    return np.asarray(values, dtype=dtype).view(Tensor)


def arange(count, device=None, dtype=np.int64):
    return np.arange(count, dtype=dtype).view(Tensor)


def zeros(shape, device=None):
    return np.zeros(shape, dtype=np.float32).view(Tensor)
"""
TERMS = """
class EventTermCfg:
    def __init__(self, func, mode, params):
        self.func, self.mode, self.params = func, mode, params


class SceneEntityCfg:
    def __init__(self, name):
        self.name = name
"""
MODULES = {
    "torch.py": TORCH,
    "isaaclab/__init__.py": "",
    "isaaclab/managers.py": TERMS,
    "isaaclab/utils.py": "def configclass(one):\n    return one\n",
    "mjlab/__init__.py": "",
    "mjlab/managers/__init__.py": "",
    "mjlab/managers/scene_entity_config.py": TERMS,
    "mjlab/managers/event_manager.py": TERMS
    + """
class RecomputeLevel:
    set_const = "set_const"


def requires_model_fields(*names, recompute):
    def mark(func):
        func.fields = names
        return func
    return mark
""",
}
FINDING = """
import sys
import numpy as np
from types import SimpleNamespace

COUNT = 5


def finder(order):
    def find(names, preserve_order):
        assert preserve_order
        return [order.index(name) for name in names], list(names)
    return find


"""
ISAAC = (
    FINDING
    + """
from isaaclab_events import MeasuredEventCfg, RANGES, DELAYS, NOISE

written = {}


def record(name):
    def write(**values):
        written[name] = {k: np.asarray(v) for k, v in values.items()}
    return write


asset = SimpleNamespace(
    device="cpu", find_joints=finder(["wheel", "elbow", "shoulder"]),
    find_bodies=finder(["base", "fore", "upper"]),
)
for call in (
    "write_joint_armature_to_sim_index", "write_joint_friction_coefficient_to_sim_index",
    "set_masses_index", "set_inertias_index", "set_coms_index",
):
    setattr(asset, call, record(call))


class Scene(dict):
    num_envs = COUNT


term = MeasuredEventCfg().measured_robot
env = SimpleNamespace(scene=Scene(robot=asset))
assert term.mode == "startup"
term.func(env, None, **term.params, seed=7)
robots = RANGES.draw(COUNT, 7)
friction = written["write_joint_friction_coefficient_to_sim_index"]
joints, bodies = ["elbow", "shoulder"], ["upper", "fore"]
assert friction["joint_ids"].tolist() == [1, 2]
assert friction["env_ids"].tolist() == list(range(COUNT))
for key, kind in (
    ("joint_friction_coeff", "coulomb_friction"), ("joint_dynamic_friction_coeff",
    "coulomb_friction"), ("joint_viscous_friction_coeff", "viscous_friction"),
):
    expected = np.stack([robots[f"{joint}.{kind}"] for joint in joints], axis=1)
    assert np.allclose(friction[key], expected), key
armature = written["write_joint_armature_to_sim_index"]
assert np.allclose(armature["armature"][:, 0], robots["elbow.armature"])
masses = written["set_masses_index"]
assert masses["body_ids"].tolist() == [2, 1]
assert np.allclose(masses["masses"], np.stack([robots[f"{b}.mass"] for b in bodies], axis=1))
inertias = written["set_inertias_index"]["inertias"]
assert inertias.shape == (COUNT, 2, 9)
assert np.allclose(inertias[:, 1].reshape(-1, 3, 3), robots["fore.inertia"])
poses = written["set_coms_index"]["coms"]
assert np.allclose(poses[:, 0, :3], robots["upper.com"])
assert np.allclose(poses[:, :, 3:], [0.0, 0.0, 0.0, 1.0])
assert DELAYS["elbow"][0] >= 0.0 and DELAYS["elbow"][1] < 0.03
assert set(NOISE) <= set(joints)
"""
)
MJLAB = (
    FINDING
    + """
from mjlab_events import EVENTS, RANGES, measured_robot

COUNT_ALL, EXTRA = 8, 6
order = ["elbow", "shoulder"]
entity = SimpleNamespace(
    find_joints=finder(order), find_bodies=finder(["fore", "upper"]),
    indexing=SimpleNamespace(joint_v_adr=[EXTRA + 1, EXTRA], body_ids=[5, 4]),
    data=SimpleNamespace(encoder_bias=np.zeros((COUNT_ALL, 2))),
)
sizes = {
    "dof_damping": (8,), "dof_frictionloss": (8,), "dof_armature": (8,), "body_mass": (6,),
    "body_ipos": (6, 3), "body_inertia": (6, 3), "body_iquat": (6, 4),
}
assert set(measured_robot.fields) == set(sizes)
model = SimpleNamespace(**{k: np.full((COUNT_ALL, *v), -1.0) for k, v in sizes.items()})
env = SimpleNamespace(
    num_envs=COUNT_ALL, device="cpu", scene={"robot": entity}, sim=SimpleNamespace(model=model)
)
term = EVENTS["measured_robot"]
import torch
chosen = torch.as_tensor([1, 3, 4, 6, 7], dtype=torch.int)
term.func(env, chosen, **term.params, seed=7)
robots = RANGES.draw(COUNT, 7)
kinds = {"viscous_friction": "dof_damping", "coulomb_friction": "dof_frictionloss",
         "armature": "dof_armature"}
for kind, field in kinds.items():
    values = getattr(model, field)
    assert np.allclose(values[chosen, EXTRA], robots[f"shoulder.{kind}"])
    assert np.allclose(values[chosen, EXTRA + 1], robots[f"elbow.{kind}"])
    assert (values[[0, 2, 5]] == -1.0).all()
    assert (values[:, :EXTRA] == -1.0).all()
assert np.allclose(entity.data.encoder_bias[chosen, 0], robots["elbow.encoder_bias"], atol=1e-6)
assert (entity.data.encoder_bias[:, 1] == 0.0).all()
fields = RANGES.mujoco_fields(robots)
for body, place in (("fore", 5), ("upper", 4)):
    own = RANGES.document["places"]["bodies"][body]
    assert np.allclose(model.body_mass[chosen, place], robots[f"{body}.mass"])
    assert np.allclose(model.body_ipos[chosen, place], robots[f"{body}.com"])
    for name in ("body_inertia", "body_iquat"):
        assert np.allclose(getattr(model, name)[chosen, place], fields[name][own], atol=1e-6)
assert (model.body_mass[:, :4] == -1.0).all()
"""
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``ranges.json`` of an arm with the written files and the stand-ins beside it."""
    folder = tmp_path_factory.mktemp("events")
    more = "ranges:\n  tolerance:\n  - {parameter: fore.mass, relative: 0.05}\n"
    more += "  - {parameter: elbow.command_delay, absolute: 0.02}\n"
    more += "  - {parameter: elbow.encoder_bias, absolute: 0.01}\n"
    twin = make_twin(folder, [record(covariance())], more, ARM)
    (folder / "ranges.json").write_text(json.dumps(ranges_of_file(str(twin))))
    write_files(folder)
    for name, text in MODULES.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize("code", [ISAAC, MJLAB], ids=["isaaclab", "mjlab"])
def test_the_event_writes_each_drawn_robot_to_its_environment_joints_and_bodies(
    written: Path, code: str
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=written, capture_output=True, text=True, check=False,
        timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
