"""Structure of a compiled model, for the dependency map."""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np

from pytest_twin.dependency import Structure
from pytest_twin.realization.features.elements import OBJ, Elements
from pytest_twin.realization.inputs import joint_inputs


def structure_of(model: mujoco.MjModel, name: str, part_ids: frozenset[str]) -> Structure:
    """Read the structure of a compiled model."""
    elements = Elements(model)
    body = elements.body

    def bodies(indices: Iterable[int]) -> tuple[str, ...]:
        return tuple(sorted({body[i] for i in indices}))

    couplings: dict[str, tuple[str, ...]] = {}
    equalities, loops = set(), set()
    leaders: dict[str, str] = {}
    for eq in range(model.neq):
        obj, ends = elements.equality_ends(eq)
        part = f"{name}/coupling:{elements.equality[eq]}"
        couplings[part] = bodies(b for i in ends for b in elements.body_of(obj, i))
        equalities.add(part)
        if int(model.eq_type[eq]) != int(mujoco.mjtEq.mjEQ_JOINT):
            loops.add(part)
        elif len(ends) == 2 and model.eq_active0[eq]:
            follower, leader = ends
            leaders[elements.joint[follower]] = elements.joint[leader]
    for tendon in range(model.ntendon):
        part = f"{name}/coupling:{elements.tendon[tendon]}"
        found = bodies(elements.tendon_bodies(tendon))
        couplings[part] = tuple(sorted({*couplings.get(part, ()), *found}))
    if model.nflex:
        couplings[f"{name}/flex:all"] = bodies(elements.flex_bodies())

    colliding = [b for b in range(model.nbody) if elements.geoms_of(b)]
    masks, meshes = {}, {}
    for b in colliding:
        geoms = elements.geoms_of(b)
        contype = int(np.bitwise_or.reduce(model.geom_contype[geoms]))
        conaffinity = int(np.bitwise_or.reduce(model.geom_conaffinity[geoms]))
        masks[body[b]] = (contype, conaffinity)
        used = set()
        for g in geoms:
            data, kind = int(model.geom_dataid[g]), int(model.geom_type[g])
            if data >= 0 and kind == int(mujoco.mjtGeom.mjGEOM_HFIELD):
                used.add(f"{name}/hfield:{elements.hfield[data]}")
            elif data >= 0:
                used.add(f"{name}/mesh:{elements.mesh[data]}")
        if used:
            meshes[body[b]] = tuple(sorted(used))

    reach = [elements.actuator_reach(a) for a in range(model.nactuator)]
    frames = {body[b]: body[b] for b in range(model.nbody)}
    frames |= {elements.site[s]: body[int(model.site_bodyid[s])] for s in range(model.nsite)}
    return Structure(
        realization=name,
        body_parent={body[b]: body[int(model.body_parentid[b])] for b in range(1, model.nbody)},
        joint_body={elements.joint[j]: body[int(model.jnt_bodyid[j])] for j in range(model.njnt)},
        joint_range={
            elements.joint[j]: (float(model.jnt_range[j, 0]), float(model.jnt_range[j, 1]))
            if model.jnt_limited[j]
            else None
            for j in range(model.njnt)
        },
        joint_type={elements.joint[j]: elements.joint_type[j] for j in range(model.njnt)},
        frame_body=frames,
        actuator_joints={
            elements.actuator[a]: tuple(elements.joint[j] for j in joints)
            for a, (joints, _) in enumerate(reach)
        },
        collision_bodies=frozenset(body[b] for b in colliding),
        couplings=couplings,
        part_ids=part_ids,
        body_tree={
            body[b]: body[int(model.tree_bodyadr[model.body_treeid[b]])]
            for b in range(model.nbody)
            if model.body_treeid[b] >= 0
        },
        actuator_bodies={
            elements.actuator[a]: bodies(pulled) for a, (_, pulled) in enumerate(reach)
        },
        equalities=frozenset(equalities),
        loops=frozenset(loops),
        contact_masks=masks,
        contact_pairs=tuple(
            (body[int(model.geom_bodyid[a])], body[int(model.geom_bodyid[b])])
            for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)
        ),
        body_meshes=meshes,
        geom_body={
            elements.geom[g]: body[int(model.geom_bodyid[g])]
            for g in range(model.ngeom)
            if mujoco.mj_id2name(model, OBJ.mjOBJ_GEOM, g)
        },
        joint_inputs={
            elements.joint[j]: taken
            for j in range(model.njnt)
            if (taken := _inputs(model, elements.joint[j]))
        },
        leaders=leaders,
        loose=frozenset(elements.joint[j] for j in _loose_joints(model, elements)),
    )


def _loose_joints(model: mujoco.MjModel, elements: Elements) -> list[int]:
    """Joints without a range that no actuator, spring, joint equality or tendon moves."""
    moved = {j for a in range(model.nactuator) for j in elements.actuator_reach(a)[0]}
    moved |= {j for tendon in range(model.ntendon) for j in elements.tendon_joints(tendon)}
    for eq in range(model.neq):
        if int(model.eq_type[eq]) == int(mujoco.mjtEq.mjEQ_JOINT):
            moved |= set(elements.equality_ends(eq)[1])
    return [
        j
        for j in range(model.njnt)
        if j not in moved and not model.jnt_limited[j] and not np.any(model.jnt_stiffness[j])
    ]


def _inputs(model: mujoco.MjModel, joint: str) -> tuple[str, ...]:
    """Command modes of the actuators of a joint, without repetition."""
    return tuple(dict.fromkeys(item.mode for item in joint_inputs(model, joint)))
