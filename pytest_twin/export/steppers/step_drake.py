"""Step a robot exported for Drake, with Drake's own plant.

python step_drake.py FOLDER MOTIONS.json RESULT.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

folder, motions = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
sys.path.insert(0, str(folder))

import drake_drives

timestep, results = motions["timestep"], []
for motion in motions["motions"]:
    plant = MultibodyPlant(timestep)
    instance = drake_drives.add_robot(plant)
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    joints = [plant.GetJointByName(name, instance) for name in motions["joints"]]
    first = [joint.position_start() for joint in joints]
    position, velocity = plant.GetPositions(context), plant.GetVelocities(context)
    position[first] = motion["position"]
    velocity[[joint.velocity_start() for joint in joints]] = motion["velocity"]
    plant.SetPositions(context, position)
    plant.SetVelocities(context, velocity)
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(instance)]
    column = [motions["joints"].index(actuator.joint().name()) for actuator in actuators]
    port = plant.get_desired_state_input_port(instance)
    simulator.Initialize()
    measured = []
    for k, row in enumerate(motion["commands"]):
        measured.append(plant.GetPositions(context)[first].tolist())
        port.FixValue(context, np.array([*(row[j] for j in column), *([0.0] * len(column))]))
        simulator.AdvanceTo((k + 1) * timestep)
    measured.append(plant.GetPositions(context)[first].tolist())
    results.append(measured)
Path(sys.argv[3]).write_text(json.dumps({"positions": results}))
