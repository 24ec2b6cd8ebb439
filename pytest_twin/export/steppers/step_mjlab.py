"""Step a robot exported for mjlab, with mjlab's own entity, actuators and simulation on the CPU.

python step_mjlab.py FOLDER MOTIONS.json RESULT.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

folder, motions = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
sys.path.insert(0, str(folder))

import mjlab_actuators
from mjlab.entity import Entity, EntityArticulationInfoCfg, EntityCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg

timestep = motions["timestep"]
results = []
for motion in motions["motions"]:
    articulation = EntityArticulationInfoCfg(actuators=mjlab_actuators.actuators(timestep))
    entity = Entity(EntityCfg(spec_fn=mjlab_actuators.spec, articulation=articulation))
    model = entity.spec.compile()
    simulation = Simulation(
        1, SimulationCfg(mujoco=MujocoCfg(timestep=timestep)), model=model, device="cpu"
    )
    entity.initialize(simulation.mj_model, simulation.model, simulation.data, "cpu")
    order = [entity.joint_names.index(name) for name in motions["joints"]]
    position, velocity = (torch.zeros((1, len(order))) for _ in range(2))
    position[0, order] = torch.tensor(motion["position"])
    velocity[0, order] = torch.tensor(motion["velocity"])
    entity.write_joint_state_to_sim(position, velocity)
    entity.reset()
    targets = torch.tensor(motion["commands"])
    send = {
        "position": entity.set_joint_position_target,
        "velocity": entity.set_joint_velocity_target,
        "effort": entity.set_joint_effort_target,
    }
    by_mode = {
        mode: [j for j, used in enumerate(motions["modes"]) if used == mode] for mode in send
    }
    simulation.forward()
    measured = []
    for row in targets:
        measured.append(simulation.data.qpos[0, order].tolist())
        for mode, columns in by_mode.items():
            if columns:
                send[mode](row[None, columns], joint_ids=[order[j] for j in columns])
        entity.write_data_to_sim()
        simulation.step()
        entity.update(timestep)
    measured.append(simulation.data.qpos[0, order].tolist())
    results.append(measured)
Path(sys.argv[3]).write_text(json.dumps({"positions": results}))
