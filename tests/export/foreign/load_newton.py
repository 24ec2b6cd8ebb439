"""Read a layer exported for Newton with Newton's own parser; prints what it read as JSON.

python load_newton.py LAYER JOINT...
"""

from __future__ import annotations

import json
import sys

from newton.actuators import parse_actuator_prim
from pxr import Sdf, Usd, UsdPhysics

layer, joints = sys.argv[1], sys.argv[2:]
stage = Usd.Stage.CreateInMemory()
for joint in joints:
    UsdPhysics.RevoluteJoint.Define(stage, f"/ROBOT/Physics/{joint}")
stage.GetRootLayer().subLayerPaths.append(Sdf.Layer.FindOrOpen(layer).identifier)
found = {}
for prim in stage.Traverse():
    parsed = parse_actuator_prim(prim)
    if parsed is not None:
        drive = parsed.drive_class.resolve_arguments(parsed.drive_kwargs)
        found[prim.GetName()] = {
            "target": parsed.target_path,
            "drive": {"class": parsed.drive_class.__name__, **drive},
            "others": [
                {"class": kind.__name__, **kind.resolve_arguments(given)}
                for kind, given in parsed.component_specs
            ],
            "friction": stage.GetPrimAtPath(parsed.target_path)
            .GetAttribute("newton:friction")
            .Get(),
        }
print(json.dumps(found, default=str))
