"""Content of parts of sites and sensors."""

from __future__ import annotations

from typing import Any

import mujoco

from pytest_twin.realization.engine import model_field
from pytest_twin.realization.features.canonical import (
    as_rounded_list,
    rotation_of,
    value_of,
)
from pytest_twin.realization.features.elements import OBJ, Elements
from pytest_twin.realization.features.surfaces import shape


def site(elements: Elements, site: int) -> dict[str, Any]:
    """Pose of a site in its body."""
    model = elements.model
    return {
        "body": elements.body[int(model.site_bodyid[site])],
        "position [m]": as_rounded_list(model.site_pos[site]),
        "quaternion": rotation_of(model.site_quat[site]),
    }


def sensor(elements: Elements, sensor: int) -> dict[str, Any]:
    """Measured quantity, object, reference frame and accuracy of a sensor."""
    model = elements.model
    obj, index = int(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor])
    ref, other = int(model.sensor_reftype[sensor]), int(model.sensor_refid[sensor])
    kind = int(model.sensor_type[sensor])
    content: dict[str, Any] = {
        "type": mujoco.mjtSensor(kind).name.removeprefix("mjSENS_").lower(),
        "of": [obj, elements.object(obj, index)],
        "in": [ref, elements.object(ref, other)],
        **{
            name: value_of(getattr(model, f"sensor_{name}")[sensor])
            for name in (
                "datatype",
                "needstage",
                "intprm",
                "dim",
                "cutoff",
                "noise",
                "history",
                "delay",
                "interval",
            )
        },
    }
    for target, at in ((obj, index), (ref, other)):
        if target == int(OBJ.mjOBJ_SITE) and at >= 0:
            drawn = [int(model.site_type[at]), as_rounded_list(model.site_size[at])]
            content.setdefault("sites", []).append([site(elements, at), drawn])
            content["site meshes"] = [int(model_field(model, "site_dataid")[at])]
        if target == int(OBJ.mjOBJ_GEOM) and at >= 0:
            content.setdefault("geoms", []).append(shape(elements, at))
    if kind == int(mujoco.mjtSensor.mjSENS_RANGEFINDER):
        # A range finder also detects visual geoms.
        shapes = [value_of(model.geom_type), value_of(model.geom_dataid), value_of(model.mesh_vert)]
        places = [value_of(model.geom_pos), value_of(model.geom_quat), value_of(model.geom_size)]
        content["all geoms"] = [*shapes, *places, value_of(model.geom_rgba[:, 3] == 0)]
    return content
