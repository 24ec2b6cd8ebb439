"""Step a robot exported for mjlab, in the environment of mjlab; prints positions as JSON.

python step_mjlab.py FOLDER COMMANDS.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import mujoco

folder, commands = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
sys.path.insert(0, str(folder))

import mjlab_actuators  # noqa: E402
from mjlab.entity import Entity, EntityArticulationInfoCfg, EntityCfg  # noqa: E402

articulation = EntityArticulationInfoCfg(actuators=mjlab_actuators.actuators())
entity = Entity(EntityCfg(spec_fn=mjlab_actuators.spec, articulation=articulation))
model = entity.spec.compile()
# As in mjlab's MujocoCfg; an entity's own options are not taken over.
model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 0.002
data = mujoco.MjData(model)
order = [model.actuator(name).id for name in commands["actuators"]]
positions = []
for row in commands["values"]:
    data.ctrl[order] = row
    mujoco.mj_step(model, data)
    positions.append([float(data.joint(name).qpos[0]) for name in commands["joints"]])
print(json.dumps({"mujoco": mujoco.__version__, "positions": positions}))
