"""Simulated reality for the tests: an arm with one or two joints whose tip touches a table.

The tip hits the table or slides on it. MuJoCo simulates it with an eighth of the time step of the
diagnosed model; one property differs from that model.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from two_pendulums import DECLARED, write

STEP, FINE = 0.002, 0.00025
SOLREF = (0.05, 1.0)
FRICTION = 0.5
_LINK = """
    <body name="{name}_link" pos="{at} 0 0">
      <joint name="{name}" axis="0 1 0" damping="{damping:.17g}" armature=".01"/>
      <geom name="{name}_geom" type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".4"
       solref="{solref[0]:.17g} {solref[1]:.17g}" friction="{friction:.17g} .005 .0001"/>{inner}
    </body>"""
_SERVO = '<position name="{name}" joint="{name}" kp="15" kv=".4"/>'


def mjcf(
    joints: tuple[str, ...],
    *,
    step: float = STEP,
    offset: float = 0.0,
    solref: tuple[float, float] = SOLREF,
    friction: float = FRICTION,
    damping: float = 0.1,
) -> str:
    """MJCF of an arm above a table, which is ``offset`` m above its nominal height."""
    inner = ""
    for index, name in reversed(list(enumerate(joints))):
        inner = _LINK.format(
            name=name, at=".3" if index else "0", solref=solref, friction=friction, inner=inner,
            damping=damping,
        )  # fmt: skip
    servos = "".join(_SERVO.format(name=name) for name in joints)
    return (
        '<mujoco model="touching"><compiler angle="radian"/>'
        f'<option timestep="{step}" integrator="implicitfast"/><worldbody>'
        f'<geom name="table" type="plane" size="1 1 .1" pos="0 0 {offset - 0.2:.17g}"'
        f' solref="{solref[0]:.17g} {solref[1]:.17g}" friction="{friction:.17g} .005 .0001"/>'
        f"{inner}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def commands(seed: int, time: np.ndarray, joints: int) -> np.ndarray:
    """(n, joints) rad: commands onto the table and off it with one joint, along it with two."""
    rng = np.random.default_rng(seed)
    middle, size = ((0.6,), (0.5,)) if joints == 1 else ((0.15, 0.8), (0.25, 0.5))
    out = np.tile(np.array(middle), (len(time), 1))
    for _ in range(3):
        f, phase = rng.uniform(0.4, 2.0, joints), rng.uniform(0.0, 2.0 * np.pi, joints)
        out += np.array(size) / 2.0 * np.sin(2.0 * np.pi * f * time[:, None] + phase)
    return out * np.minimum(time / 0.3, 1.0)[:, None]


def case(
    folder: Path, joints: tuple[str, ...], *, seconds: float = 2.0, **hidden: object
) -> list[str]:
    """Write a model and three recordings, one held out; return them as command-line arguments."""
    (folder / "model.xml").write_text(mjcf(joints))
    model = mujoco.MjModel.from_xml_string(mjcf(joints, step=FINE, **hidden))  # type: ignore[arg-type]
    words = [str(folder / "model.xml")]
    for seed, role in ((1, "fit"), (2, "fit"), (3, "held_out")):
        data = mujoco.MjData(model)
        count = round(seconds / FINE)
        sent_at = 0.01 * np.arange(round(seconds / 0.01))
        sent = commands(seed, sent_at, len(joints))
        moved = np.empty((count, len(joints)))
        for k in range(count):
            moved[k] = data.qpos
            data.ctrl[:] = sent[min(int(k * FINE / 0.01 + 1e-9), len(sent) - 1)]
            mujoco.mj_step(model, data)
        every = round(0.005 / FINE)
        noise = np.random.default_rng([seed, 1]).standard_normal((len(moved[::every]), len(joints)))
        path = folder / f"{role}{seed}.mcap"
        seen_at = FINE * np.arange(0, count, every)
        seen = moved[::every] + 1e-4 * noise
        write(path, joints, sent_at, sent, seen_at, seen, role, metadata=DECLARED)
        words.append(str(path))
    return words
