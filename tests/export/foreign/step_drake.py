"""Step a robot exported for Drake; prints positions as JSON.

python step_drake.py FOLDER COMMANDS.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

folder, commands = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
sys.path.insert(0, str(folder))

import drake_drives  # noqa: E402

plant = MultibodyPlant(commands["timestep"])
instance = drake_drives.add_robot(plant)
plant.Finalize()
simulator = Simulator(plant)
context = simulator.get_mutable_context()
actuated = [plant.get_joint_actuator(i).joint() for i in plant.GetJointActuatorIndices(instance)]
column = [commands["joints"].index(joint.name()) for joint in actuated]
joints = [plant.GetJointByName(name, instance) for name in commands["joints"]]
port = plant.get_desired_state_input_port(instance)
positions = []
for k, row in enumerate(commands["values"]):
    desired = [row[j] for j in column]
    port.FixValue(context, np.array([*desired, *([0.0] * len(desired))]))
    simulator.AdvanceTo((k + 1) * commands["timestep"])
    positions.append([joint.get_angle(context) for joint in joints])
print(json.dumps({"positions": positions}))
