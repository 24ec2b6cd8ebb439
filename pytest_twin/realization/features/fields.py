"""Layer of the dependency map for each field of MuJoCo's model.

Each field belongs to a layer, is derived from such fields, or is visual. A field in none of the
tables, such as one of a newer MuJoCo, belongs to the part ``other``, on which every golden depends.
"""

from __future__ import annotations

from typing import Any

KINEMATICS = frozenset(
    {
        "body_parentid",
        "body_pos",
        "body_quat",
        "body_mocapid",
        "jnt_type",
        "jnt_bodyid",
        "jnt_pos",
        "jnt_axis",
        "qpos0",
    }
)
INERTIA = frozenset(
    {"body_mass", "body_ipos", "body_iquat", "body_inertia", "body_gravcomp", "geom_fluid"}
)
JOINT = frozenset(
    {
        "jnt_stiffness",
        "jnt_stiffnesspoly",
        "jnt_springyield",
        "jnt_solref",
        "jnt_solimp",
        "jnt_margin",
        "jnt_actfrclimited",
        "jnt_actfrcrange",
        "jnt_actgravcomp",
        "qpos_spring",
        "dof_solref",
        "dof_solimp",
        "dof_frictionloss",
        "dof_armature",
        "dof_damping",
        "dof_dampingpoly",
    }
)
LIMIT = frozenset({"jnt_limited", "jnt_range"})
TREE = frozenset({"tree_sleep_policy"})
COLLISION = frozenset(
    {
        "geom_type",
        "geom_contype",
        "geom_conaffinity",
        "geom_condim",
        "geom_bodyid",
        "geom_dataid",
        "geom_priority",
        "geom_solmix",
        "geom_solref",
        "geom_solimp",
        "geom_size",
        "geom_pos",
        "geom_quat",
        "geom_friction",
        "geom_margin",
        "geom_gap",
        "geom_surfacevel",
        "geom_adhesion",
    }
)
MESH = frozenset(
    {
        "mesh_vert",
        "mesh_face",
        "mesh_graph",
        "oct_depth",
        "oct_child",
        "oct_aabb",
        "oct_coeff",
        "hfield_size",
        "hfield_nrow",
        "hfield_ncol",
        "hfield_data",
    }
)
PAIRS = frozenset(
    {
        "pair_dim",
        "pair_geom1",
        "pair_geom2",
        "pair_solref",
        "pair_solreffriction",
        "pair_solimp",
        "pair_margin",
        "pair_gap",
        "pair_adhesion",
        "pair_friction",
        "exclude_signature",
    }
)
EQUALITY = frozenset(
    {
        "eq_type",
        "eq_obj1id",
        "eq_obj2id",
        "eq_objtype",
        "eq_active0",
        "eq_solref",
        "eq_solimp",
        "eq_data",
    }
)
TENDON = frozenset(
    {
        "tendon_type",
        "tendon_limited",
        "tendon_actfrclimited",
        "tendon_solref_lim",
        "tendon_solimp_lim",
        "tendon_solref_fri",
        "tendon_solimp_fri",
        "tendon_range",
        "tendon_actfrcrange",
        "tendon_margin",
        "tendon_stiffness",
        "tendon_stiffnesspoly",
        "tendon_damping",
        "tendon_dampingpoly",
        "tendon_armature",
        "tendon_frictionloss",
        "tendon_lengthspring",
        "tendon_springyield",
        "wrap_type",
        "wrap_objid",
        "wrap_prm",
    }
)
FLEX = frozenset(
    f"flex_{name}"
    for name in [
        "contype",
        "conaffinity",
        "condim",
        "priority",
        "solmix",
        "solref",
        "solimp",
        "friction",
        "margin",
        "gap",
        "selfcollide",
        "activelayers",
        "passive",
        "dim",
        "interp",
        "cellnum",
        "nodeadr",
        "nodenum",
        "vertadr",
        "vertnum",
        "edgeadr",
        "edgenum",
        "elemadr",
        "elemnum",
        "elemdataadr",
        "stiffnessadr",
        "elemedgeadr",
        "bendingadr",
        "plasticadr",
        "plasticmode",
        "shellnum",
        "shelldataadr",
        "nodebodyid",
        "vertbodyid",
        "vertcell",
        "edge",
        "edgeflap",
        "elem",
        "elemedge",
        "elemlayer",
        "shell",
        "vert",
        "vert0",
        "node",
        "node0",
        "radius",
        "size",
        "stiffness",
        "bending",
        "damping",
        "yield",
        "edgestiffness",
        "edgedamping",
        "edgeequality",
        "rigid",
        "centered",
        # Before MuJoCo 3.15.
        "internal",
        "evpairadr",
        "evpairnum",
        "evpair",
    ]
)
ACTUATOR = frozenset(
    f"actuator_{name}"
    for name in [
        "trntype",
        "dyntype",
        "gaintype",
        "biastype",
        "ctrlnum",
        "ctrlspec",
        "outnum",
        "actnum",
        "trnid",
        "cranklength",
        "dynprm",
        "gainprm",
        "biasprm",
        "actlimited",
        "actrange",
        "actearly",
        "history",
        "delay",
        "damping",
        "dampingpoly",
        "armature",
        "group",
        "forcelimited",
        "forcerange",
        "ctrllimited",
        "ctrlrange",
        "gear",
        "lengthrange",
    ]
)
FRAME = frozenset({"site_bodyid", "site_pos", "site_quat"})
SENSOR = frozenset(
    {
        *(
            f"sensor_{name}"
            for name in [
                "type",
                "datatype",
                "needstage",
                "objtype",
                "objid",
                "reftype",
                "refid",
                "intprm",
                "dim",
                "cutoff",
                "noise",
                "history",
                "delay",
                "interval",
            ]
        ),
        "site_type",
        "site_size",
        "site_dataid",
    }
)
KEYFRAME = frozenset(
    {
        "key_time",
        "key_qpos",
        "key_qvel",
        "key_act",
        "key_mpos",
        "key_mquat",
        "key_ctrl",
        "key_plastic",
    }
)
CUSTOM = frozenset(
    {
        "numeric_data",
        "numeric_adr",
        "numeric_size",
        "text_data",
        "text_adr",
        "text_size",
        "tuple_adr",
        "tuple_size",
        "tuple_objtype",
        "tuple_objid",
        "tuple_objprm",
        *(
            f"{family}_user"
            for family in ("actuator", "body", "cam", "geom", "jnt", "sensor", "site", "tendon")
        ),
    }
)
OPTION = frozenset({"opt", "stat", "nconmax", "njmax", "narena"})

FIELDS_OF_LAYER: dict[str, frozenset[str]] = {
    "kinematics": KINEMATICS,
    "inertia": INERTIA,
    "joint": JOINT,
    "limit": LIMIT,
    "tree": TREE,
    "collision": COLLISION,
    "mesh": MESH,
    "contact": PAIRS,
    "coupling": EQUALITY | TENDON,
    "flex": FLEX,
    "actuator": ACTUATOR,
    "frame": FRAME,
    "sensor": SENSOR,
    "keyframe": KEYFRAME,
    "custom": CUSTOM,
    "option": OPTION,
}
"""Layer -> fields of ``mjModel`` in its parts."""

DERIVED = frozenset(
    {
        # computed by the compiler from fields of the layers; the first seven before MuJoCo 4
        *("flex_vertedgeadr", "flex_vertedgenum", "flex_vertedge", "flex_vertmetric"),
        *("flexvert_J_rownnz", "flexvert_J_rowadr", "flexvert_J_colind"),
        "body_rootid",
        "body_weldid",
        "body_treeid",
        "body_simple",
        "body_sameframe",
        "body_subtreemass",
        "body_invweight0",
        "body_margin",
        "body_contype",
        "body_conaffinity",
        "dof_bodyid",
        "dof_jntid",
        "dof_parentid",
        "dof_treeid",
        "dof_simplenum",
        "dof_invweight0",
        "dof_M0",
        "dof_length",
        "geom_sameframe",
        "geom_aabb",
        "geom_rbound",
        "site_sameframe",
        "jnt_actuatorid",
        "tendon_actuatorid",
        "tendon_treenum",
        "tendon_treeid",
        "tendon_length0",
        "tendon_invweight0",
        "actuator_acc0",
        "actuator_length0",
        "pair_signature",
        "flexedge_length0",
        "flexedge_invweight0",
        "flexedge_rigid",
        "flg_gravcomp",
        "flg_surfacevel",
        "flg_adhesion",
        "mesh_extrema",
        "mesh_scale",
        "mesh_pos",
        "mesh_quat",
        "mesh_polynormal",
        "mesh_polyvert",
        "mesh_polymap",
        # bounding volumes
        "bvh_depth",
        "bvh_child",
        "bvh_nodeid",
        "bvh_aabb",
        # sparse layouts
        *(f"{name}_{end}" for name in "BMD" for end in ("rownnz", "rowadr", "colind")),
        *(f"{name}_J_{end}" for name in ("ten", "flexedge") for end in ("rownnz", "rowadr")),
        "ten_J_colind",
        "flexedge_J_colind",
        "D_diag",
        "mapM2M",
        "mapM2D",
        "mapD2M",
        "efm0_dofid",
        "efm0_L_rownnz",
        "efm0_L_rowadr",
        "efm0_L_colind",
        "efm0_L",
        "efmC_perm",
        # hash of the model's own layout
        "signature",
        "names_map",
        # addresses and counts of elements whose content is in a layer
        *(f"body_{end}" for end in ("jntnum", "jntadr", "dofnum", "dofadr", "geomnum", "geomadr")),
        *("body_bvhadr", "body_bvhnum", "flex_bvhadr", "flex_bvhnum"),
        *("jnt_qposadr", "jnt_dofadr", "jnt_plasticadr", "dof_Madr"),
        *(f"tree_{end}" for end in ("bodyadr", "bodynum", "dofadr", "dofnum")),
        *("actuator_ctrladr", "actuator_outadr", "actuator_actadr", "actuator_historyadr"),
        *("sensor_adr", "sensor_historyadr"),
        *("tendon_adr", "tendon_num", "tendon_plasticadr", "hfield_adr"),
        *(
            f"mesh_{name}{end}"
            for name in ("vert", "face", "bvh", "oct", "normal", "poly")
            for end in ("adr", "num")
        ),
        *("mesh_graphadr", "mesh_polyvertadr", "mesh_polyvertnum"),
        *("mesh_polymapadr", "mesh_polymapnum"),
    }
)
"""Fields that are determined by fields of the layers."""

VISUAL = frozenset(
    {
        "vis",
        "names",
        "paths",
        "jnt_group",
        "geom_group",
        "geom_matid",
        "geom_rgba",
        "geom_castshadow",
        "site_group",
        "site_matid",
        "site_rgba",
        "tendon_group",
        "tendon_matid",
        "tendon_rgba",
        "tendon_width",
        "flex_group",
        "flex_matid",
        "flex_rgba",
        "flex_flatskin",
        "flex_texcoord",
        "flex_texcoordadr",
        "flex_elemtexcoord",
        "mesh_normal",
        "mesh_facenormal",
        "mesh_texcoord",
        "mesh_texcoordadr",
        "mesh_texcoordnum",
        "mesh_facetexcoord",
        "mesh_pathadr",
        "hfield_pathadr",
        "skin_pathadr",
    }
)
"""Fields that change the rendering only."""

_VISUAL_FAMILIES = ("cam_", "light_", "mat_", "tex_", "skin_")
_ADDRESS_FAMILIES = ("name_",)


def model_fields(model: Any) -> tuple[str, ...]:
    """Names of all data fields of an ``mjModel``, sorted."""
    return tuple(
        name
        for name in dir(model)
        if not name.startswith("_") and not callable(getattr(model, name))
    )


def layer_of(field: str, model: Any) -> str | None:
    """Layer of a field of ``model``; ``other`` for an unknown field, None without effect."""
    for layer, names in FIELDS_OF_LAYER.items():
        if field in names:
            return layer
    if field in DERIVED or field in VISUAL:
        return None
    if field.startswith((*_VISUAL_FAMILIES, *_ADDRESS_FAMILIES)):
        return None
    # Counts follow from the named elements, which are parts themselves.
    if field.startswith("n") and isinstance(getattr(model, field), int):
        return None
    return "other"
