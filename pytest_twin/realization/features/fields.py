"""Layer of the dependency map for each field of MuJoCo's model.

Each field belongs to a layer, is derived from such fields, or is visual. A field in none of the
tables, such as one of a newer MuJoCo, belongs to the part ``other``, on which every golden depends.
"""

from __future__ import annotations

from typing import Any


def _fields(table: str) -> frozenset[str]:
    """Field names of a table; a line ``body_: pos quat`` means ``body_pos`` and ``body_quat``."""
    names = set()
    for line in table.strip().splitlines():
        prefix, _, ends = line.rpartition(":")
        names |= {prefix.strip() + end for end in ends.split()}
    return frozenset(names)


FIELDS_OF_LAYER: dict[str, frozenset[str]] = {
    "kinematics": _fields(
        """
        body_: parentid pos quat mocapid
        jnt_: type bodyid pos axis
        qpos0
        """
    ),
    "inertia": _fields(
        """
        body_: mass ipos iquat inertia gravcomp
        geom_fluid
        """
    ),
    "joint": _fields(
        """
        jnt_: stiffness stiffnesspoly springyield solref solimp margin actfrclimited actfrcrange
        jnt_: actgravcomp
        dof_: solref solimp frictionloss armature damping dampingpoly
        qpos_spring
        """
    ),
    "limit": _fields("jnt_: limited range"),
    "tree": _fields("tree_sleep_policy"),
    "collision": _fields(
        """
        geom_: type contype conaffinity condim bodyid dataid priority solmix solref solimp size pos
        geom_: quat friction margin gap surfacevel adhesion
        """
    ),
    "mesh": _fields(
        """
        mesh_: vert face graph
        oct_: depth child aabb coeff
        hfield_: size nrow ncol data
        """
    ),
    "contact": _fields(
        """
        pair_: dim geom1 geom2 solref solreffriction solimp margin gap adhesion friction
        exclude_signature
        """
    ),
    "coupling": _fields(
        """
        eq_: type obj1id obj2id objtype active0 solref solimp data
        tendon_: type limited actfrclimited solref_lim solimp_lim solref_fri solimp_fri range
        tendon_: actfrcrange margin stiffness stiffnesspoly damping dampingpoly armature
        tendon_: frictionloss lengthspring springyield
        wrap_: type objid prm
        """
    ),
    "flex": _fields(
        """
        flex_: contype conaffinity condim priority solmix solref solimp friction margin gap
        flex_: selfcollide activelayers passive dim interp cellnum nodeadr nodenum vertadr vertnum
        flex_: edgeadr edgenum elemadr elemnum elemdataadr stiffnessadr elemedgeadr bendingadr
        flex_: plasticadr plasticmode shellnum shelldataadr nodebodyid vertbodyid vertcell edge
        flex_: edgeflap elem elemedge elemlayer shell vert vert0 node node0 radius size stiffness
        flex_: bending damping yield edgestiffness edgedamping edgeequality rigid centered internal
        flex_: evpairadr evpairnum evpair
        """
    ),
    "actuator": _fields(
        """
        actuator_: damping trntype dyntype gaintype biastype ctrlnum ctrlspec outnum actnum trnid
        actuator_: cranklength dynprm gainprm biasprm actlimited actrange actearly history delay
        actuator_: dampingpoly armature group forcelimited forcerange ctrllimited ctrlrange gear
        actuator_: lengthrange
        """
    ),
    "frame": _fields("site_: bodyid pos quat"),
    "sensor": _fields(
        """
        sensor_: dim history delay type datatype needstage objtype objid reftype refid intprm cutoff
        sensor_: noise interval
        site_: type size dataid
        """
    ),
    "keyframe": _fields("key_: time qpos qvel act mpos mquat ctrl plastic"),
    "custom": _fields(
        """
        numeric_: data adr size
        text_: data adr size
        tuple_: adr size objtype objid objprm
        actuator_user body_user cam_user geom_user jnt_user sensor_user site_user tendon_user
        """
    ),
    "option": _fields("opt stat nconmax njmax narena"),
}
"""Layer -> fields of ``mjModel`` in its parts."""

# Computed by the compiler from fields of the layers: bounding volumes, sparse layouts, hashes of
# the layout, and addresses and counts of elements whose content is in a layer. Some fields of
# edges and vertices existed before MuJoCo 4 only, and some of flex before 3.15.
DERIVED = _fields(
    """
    flexedge_: J_rowadr J_rownnz length0 invweight0 rigid J_colind
    mesh_: bvhadr bvhnum faceadr facenum normaladr normalnum octadr octnum polyadr polynum
    mesh_: vertadr vertnum extrema scale pos quat polynormal polyvert polymap graphadr
    mesh_: polyvertadr polyvertnum polymapadr polymapnum
    ten_: J_rowadr J_rownnz J_colind
    flex_: vertedgeadr vertedgenum vertedge vertmetric bvhadr bvhnum
    flexvert_: J_rownnz J_rowadr J_colind
    body_: rootid weldid treeid simple sameframe subtreemass invweight0 margin contype
    body_: conaffinity jntnum jntadr dofnum dofadr geomnum geomadr bvhadr bvhnum
    dof_: bodyid jntid parentid treeid simplenum invweight0 M0 length Madr
    geom_: sameframe aabb rbound
    jnt_: actuatorid qposadr dofadr plasticadr
    tendon_: actuatorid treenum treeid length0 invweight0 adr num plasticadr
    actuator_: acc0 length0 ctrladr outadr actadr historyadr
    flg_: gravcomp surfacevel adhesion
    bvh_: depth child nodeid aabb
    B_: rownnz rowadr colind
    D_: rownnz rowadr colind diag
    M_: rownnz rowadr colind
    efm0_: dofid L_rownnz L_rowadr L_colind L
    tree_: dofnum dofadr bodyadr bodynum
    sensor_: adr historyadr
    site_sameframe pair_signature mapM2M mapM2D mapD2M signature efmC_perm names_map hfield_adr
    """
)
"""Fields that are determined by fields of the layers."""

VISUAL = _fields(
    """
    geom_: group matid rgba castshadow
    site_: group matid rgba
    tendon_: group matid rgba width
    flex_: group matid rgba flatskin texcoord texcoordadr elemtexcoord
    mesh_: normal facenormal texcoord texcoordadr texcoordnum facetexcoord pathadr
    vis names paths jnt_group hfield_pathadr skin_pathadr
    """
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
