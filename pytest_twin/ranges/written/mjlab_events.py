"""Events for mjlab: each environment gets a robot of ``ranges.json``.

    from mjlab_events import EVENTS

    cfg.events |= EVENTS

Correlated parameters must be drawn together, so there is one event and not one for each field. It
runs at startup: the robot of an environment is the same in all episodes. ``mode="reset"`` draws a
new robot for each episode.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from mjlab.managers.event_manager import EventTermCfg, RecomputeLevel, requires_model_fields
from mjlab.managers.scene_entity_config import SceneEntityCfg
from sampler import Ranges

RANGES = Ranges.load(Path(__file__).with_name("ranges.json"))
_JOINT_FIELDS = {"viscous_friction": "dof_damping", "coulomb_friction": "dof_frictionloss",
                 "armature": "dof_armature"}  # fmt: skip


@requires_model_fields(
    "dof_damping", "dof_frictionloss", "dof_armature", "body_mass", "body_ipos", "body_inertia",
    "body_iquat", recompute=RecomputeLevel.set_const,
)  # fmt: skip
def measured_robot(env, env_ids, asset_cfg, seed=None):
    """Draw a robot for each environment.

    Args:
        env_ids: (n,) which environments, None for all.
        asset_cfg: the robot, with its joints and bodies in the order of the names below.
        seed: seed of the draws; None for a different one each time.
    """
    if env_ids is None:
        env_ids = torch.arange(env.num_envs, device=env.device, dtype=torch.int)
    robots = RANGES.draw(len(env_ids), seed)
    entity = env.scene[asset_cfg.name]
    model, rows = env.sim.model, env_ids.long()

    def put(name: str, index: int, values: np.ndarray) -> None:
        field = getattr(model, name)
        field[rows, index] = torch.as_tensor(values, dtype=torch.float32, device=env.device)

    joints, names = entity.find_joints(JOINTS, preserve_order=True)
    for local, joint in zip(joints, names, strict=True):
        dof = int(entity.indexing.joint_v_adr[local])
        for kind, field in _JOINT_FIELDS.items():
            if f"{joint}.{kind}" in robots:
                put(field, dof, robots[f"{joint}.{kind}"])
        if f"{joint}.encoder_bias" in robots:
            bias = torch.as_tensor(robots[f"{joint}.encoder_bias"], dtype=torch.float32)
            entity.data.encoder_bias[rows, local] = bias.to(env.device)
    if not BODIES:
        return
    fields = RANGES.mujoco_fields(robots)
    bodies, found = entity.find_bodies(BODIES, preserve_order=True)
    for local, body in zip(bodies, found, strict=True):
        index = int(entity.indexing.body_ids[local])
        own = RANGES.document["places"]["bodies"][body]
        for name in ("body_mass", "body_ipos", "body_inertia", "body_iquat"):
            put(name, index, fields[name][own])


JOINTS = tuple(RANGES.document["places"]["joints"])
BODIES = tuple(RANGES.document["places"]["bodies"])
EVENTS = {
    "measured_robot": EventTermCfg(
        func=measured_robot, mode="startup", params={"asset_cfg": SceneEntityCfg("robot")}
    )
}
"""Delays belong to the configuration of actuators and noise to that of observations; ``DELAYS`` and
``NOISE`` have their values."""
DELAYS = {one["joint"]: one["range"] for one in RANGES.document["quantities"]
          if one["name"].endswith(".command_delay")}  # fmt: skip
"""Joint -> range of its command's delay, s."""
NOISE = {one["joint"]: one["std"] for one in RANGES.document["noise"]}
"""Joint -> standard deviation of its encoder's noise, rad or m."""
