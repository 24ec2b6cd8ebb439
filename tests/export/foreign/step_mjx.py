"""Step a robot exported for MuJoCo Playground with MJX; prints the last positions as JSON.

python step_mjx.py MODEL STEPS
"""

from __future__ import annotations

import json
import sys

import jax
import mujoco
import numpy as np
from mujoco import mjx

jax.config.update("jax_enable_x64", True)
model = mujoco.MjModel.from_xml_path(sys.argv[1])
on_device, data = mjx.put_model(model), mujoco.MjData(model)
state = mjx.make_data(model)
step = jax.jit(mjx.step)
for k in range(int(sys.argv[2])):
    control = 0.4 * np.sin(6.0 * k * model.opt.timestep * np.arange(1, model.nu + 1))
    data.ctrl[:] = control
    mujoco.mj_step(model, data)
    state = step(on_device, state.replace(ctrl=jax.numpy.array(control)))
print(json.dumps({"mujoco": data.qpos.tolist(), "mjx": np.array(state.qpos).tolist()}))
