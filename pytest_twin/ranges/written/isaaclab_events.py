"""``EventTerm`` configuration for Isaac Lab 3: each environment gets a robot of ``ranges.json``.

    from isaaclab_events import MeasuredEventCfg

    events: MeasuredEventCfg = MeasuredEventCfg()

Correlated parameters must be drawn together, so there is one term. Isaac Lab's own
``randomize_joint_parameters`` draws static, dynamic and viscous friction from one pair of numbers;
here each has its own distribution. In Isaac Sim 5 and later joint friction is an effort, N*m or N.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from isaaclab.managers import EventTermCfg as EventTerm
from isaaclab.managers import SceneEntityCfg
from isaaclab.utils import configclass
from sampler import Ranges

RANGES = Ranges.load(Path(__file__).with_name("ranges.json"))
JOINTS = list(RANGES.document["places"]["joints"])
BODIES = list(RANGES.document["places"]["bodies"])


def measured_robot(env, env_ids, asset_cfg, seed=None):
    """Draw a robot for each environment.

    Args:
        env_ids: (n,) which environments, None for all.
        seed: seed of the draws; None for a different one each time.
    """
    asset = env.scene[asset_cfg.name]
    if env_ids is None:
        env_ids = torch.arange(env.scene.num_envs, device=asset.device)
    robots = RANGES.draw(len(env_ids), seed)

    def table(names: list[str], kind: str) -> torch.Tensor:
        columns = np.stack([robots[f"{name}.{kind}"] for name in names], axis=1)
        return torch.as_tensor(columns, dtype=torch.float32, device=asset.device)

    for kinds in (("coulomb_friction", "viscous_friction"), ("armature",)):
        names = [joint for joint in JOINTS if all(f"{joint}.{kind}" in robots for kind in kinds)]
        if not names:
            continue
        ids, names = asset.find_joints(names, preserve_order=True)
        if kinds == ("armature",):
            asset.write_joint_armature_to_sim_index(
                armature=table(names, "armature"), joint_ids=ids, env_ids=env_ids
            )
            continue
        dry = table(names, "coulomb_friction")
        asset.write_joint_friction_coefficient_to_sim_index(
            joint_friction_coeff=dry,
            joint_dynamic_friction_coeff=dry,
            joint_viscous_friction_coeff=table(names, "viscous_friction"),
            joint_ids=ids,
            env_ids=env_ids,
        )
    if BODIES:
        ids, names = asset.find_bodies(BODIES, preserve_order=True)
        asset.set_masses_index(masses=table(names, "mass"), body_ids=ids, env_ids=env_ids)
        asset.set_inertias_index(
            inertias=table(names, "inertia").flatten(2), body_ids=ids, env_ids=env_ids
        )
        # The pose has the orientation of the body's axes, in which the inertia is given.
        centres = torch.zeros((len(env_ids), len(names), 7), device=asset.device)
        centres[..., :3], centres[..., 6] = table(names, "com"), 1.0
        asset.set_coms_index(coms=centres, body_ids=ids, env_ids=env_ids)


@configclass
class MeasuredEventCfg:
    """One term at startup: the robot of an environment is the same in all episodes."""

    measured_robot = EventTerm(
        func=measured_robot, mode="startup", params={"asset_cfg": SceneEntityCfg("robot")}
    )


DELAYS = {one["joint"]: one["range"] for one in RANGES.document["quantities"]
          if one["name"].endswith(".command_delay")}  # fmt: skip
"""Joint -> range of its command's delay, s: ``min_delay`` and ``max_delay`` of a delayed actuator,
in steps of physics."""
NOISE = {one["joint"]: one["std"] for one in RANGES.document["noise"]}
"""Joint -> standard deviation of its encoder's noise, rad or m: ``GaussianNoiseCfg(std=...)`` of
the observation."""
