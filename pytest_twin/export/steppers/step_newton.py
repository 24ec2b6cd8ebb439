"""Step a robot exported for Newton: its USD layer read by Newton's parser, Newton's own actuators.

python step_newton.py FOLDER MOTIONS.json RESULT.json
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import newton
import numpy as np
import warp as wp
from newton.actuators import Delay, parse_actuator_prim
from newton.solvers import SolverMuJoCo
from pxr import Sdf, Usd, UsdPhysics

folder, motions = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
wp.config.quiet = True
wp.set_device("cpu")

builder = newton.ModelBuilder()
SolverMuJoCo.register_custom_attributes(builder)
builder.add_mjcf(str(folder / "model.xml"), enable_self_collisions=True)
joints = {label.split("/")[-1]: k for k, label in enumerate(builder.joint_label)}
dofs = {name: builder.joint_qd_start[k] for name, k in joints.items()}
coordinates = {name: builder.joint_q_start[k] for name, k in joints.items()}

stage = Usd.Stage.CreateInMemory()
for name, k in joints.items():
    is_slide = builder.joint_type[k] == newton.JointType.PRISMATIC
    kind = UsdPhysics.PrismaticJoint if is_slide else UsdPhysics.RevoluteJoint
    kind.Define(stage, f"/ROBOT/Physics/{name}")
stage.GetRootLayer().subLayerPaths.append(
    Sdf.Layer.FindOrOpen(str(folder / "newton_actuators.usda")).identifier
)
for prim in stage.Traverse():
    dof = dofs.get(prim.GetName())
    if prim.HasAttribute("newton:armature") and dof is not None:
        builder.joint_armature[dof] = prim.GetAttribute("newton:armature").Get()
        builder.joint_friction[dof] = prim.GetAttribute("newton:friction").Get()
        damping = prim.GetAttribute("newton:damping").Get()
        is_slide = prim.IsA(UsdPhysics.PrismaticJoint)
        builder.joint_damping[dof] = damping if is_slide else math.degrees(damping)
    parsed = parse_actuator_prim(prim)
    if parsed is None:
        continue
    name = parsed.target_path.rsplit("/", 1)[-1]
    delays = [given["delay_steps"] for kind, given in parsed.component_specs if kind is Delay]
    builder.add_actuator(
        parsed.drive_class,
        index=dofs[name],
        pos_index=coordinates[name],
        clamping=[each for each in parsed.component_specs if each[0] is not Delay],
        delay_steps=delays[0] if delays else None,
        **parsed.drive_kwargs,
    )
model = builder.finalize(device="cpu")
timestep, results = motions["timestep"], []
positions = [coordinates[name] for name in motions["joints"]]
velocities = [dofs[name] for name in motions["joints"]]
for motion in motions["motions"]:
    solver = SolverMuJoCo(model, use_mujoco_cpu=True, disable_contacts=model.shape_count == 0)
    state, following, control = model.state(), model.state(), model.control()
    q, qd = state.joint_q.numpy(), state.joint_qd.numpy()
    q[positions], qd[velocities] = motion["position"], motion["velocity"]
    state.joint_q.assign(q)
    state.joint_qd.assign(qd)
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    memories = [(actuator.state(), actuator.state()) for actuator in model.actuators]
    targets = {
        "position": np.zeros(model.joint_coord_count, dtype=np.float32),
        "velocity": np.zeros(model.joint_dof_count, dtype=np.float32),
        "effort": np.zeros(model.joint_dof_count, dtype=np.float32),
    }
    measured = []
    for row in motion["commands"]:
        measured.append(state.joint_q.numpy()[positions].tolist())
        for j, mode in enumerate(motions["modes"]):
            if mode:
                targets[mode][(positions if mode == "position" else velocities)[j]] = row[j]
        control.joint_target_q.assign(targets["position"])
        control.joint_target_qd.assign(targets["velocity"])
        control.joint_act.assign(targets["effort"])
        control.joint_f.zero_()
        for k, actuator in enumerate(model.actuators):
            now, then = memories[k]
            actuator.step(state, control, now, then, dt=timestep)
            memories[k] = then, now
        solver.step(state, following, control, None, timestep)
        state, following = following, state
    measured.append(state.joint_q.numpy()[positions].tolist())
    results.append(measured)
Path(sys.argv[3]).write_text(json.dumps({"positions": results}))
