"""Diagnose hidden effects in a supplier's robot from ``example-robot-data``.

    python benchmarks/suppliers.py --out DIR [--robot ur5 | xarm7] [--bare] [--steps] [--timestep S]

MuJoCo simulates with a time step of 0.1 ms, a twentieth of the model's. The recordings have
positions only, with jitter of the stamps and encoder noise; three are fitted and two held out. The
hidden effects are a payload, an elbow command delay and higher shoulder damping (ur5), or dry
friction and an encoder bias (xarm7). The script prints hidden effects and findings.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path

import mujoco
import numpy as np

from pytest_twin.formats.mcap import JointSeries, write_recording

STEP, FINE, NOISE = 0.002, 1e-4, 5e-5
SECONDS, SETTLE, SENT = 10.0, 2.0, 0.01
ROLES = ("fit", "fit", "fit", "held_out", "held_out")


@dataclass(frozen=True)
class Supplied:
    """A robot with its hidden effects.

    Attributes:
        urdf: path of its file in the package.
        home: (joints,) centre of its motion, rad.
        kp, kv, armature, damping, friction: (joints,) nominal parameters, SI units.
        load: payload: mass, kg, and distance along the last joint's axis, m.
        truth: description of the hidden effects.
        hide: function that changes the recorded model.
        late: (joints,) command delays, s; ``bias``: (joints,) encoder biases, rad.
    """

    urdf: str
    home: tuple[float, ...]
    kp: tuple[float, ...]
    kv: tuple[float, ...]
    armature: tuple[float, ...]
    damping: tuple[float, ...]
    friction: tuple[float, ...]
    load: tuple[float, float]
    truth: str
    hide: Callable[[mujoco.MjModel], None]
    late: tuple[float, ...]
    bias: tuple[float, ...]


def _drags(model: mujoco.MjModel) -> None:
    model.dof_damping[1] += 15.0


def _rubs(model: mujoco.MjModel) -> None:
    model.dof_frictionloss[1] += 2.5


ROBOTS = {
    "ur5": Supplied(
        "ur_description/urdf/ur5_robot.urdf",
        home=(0.0, -1.2, 1.3, -1.6, -1.57, 0.3),
        kp=(3000.0, 5000.0, 2500.0, 250.0, 200.0, 180.0),
        kv=(80.0, 130.0, 65.0, 7.0, 5.0, 5.0),
        armature=(0.3, 0.3, 0.2, 0.05, 0.05, 0.05),
        damping=(4.0, 4.0, 3.0, 1.0, 1.0, 0.6),
        friction=(2.0, 2.0, 1.5, 0.5, 0.5, 0.4),
        load=(1.5, 0.1),
        truth="payload 1.5 kg at 0.1 m; elbow_joint 16 ms late; viscous friction of "
        "shoulder_lift_joint 15 N*m*s/rad more",
        hide=_drags,
        late=(0.0, 0.0, 0.016, 0.0, 0.0, 0.0),
        bias=(0.0,) * 6,
    ),
    "xarm7": Supplied(
        "xarm_description/urdf/xarm7.urdf",
        home=(0.0, -0.4, 0.0, 1.2, 0.0, 0.8, 0.0),
        kp=(800.0, 800.0, 600.0, 600.0, 300.0, 200.0, 100.0),
        kv=(20.0, 20.0, 15.0, 15.0, 8.0, 5.0, 2.0),
        armature=(0.0,) * 7,
        damping=(10.0, 10.0, 5.0, 5.0, 5.0, 2.0, 2.0),
        friction=(1.0,) * 7,
        load=(0.8, 0.16),
        truth="payload 0.8 kg at 0.16 m; Coulomb friction of joint2 2.5 N*m more; the zero of "
        "joint6 0.012 rad off",
        hide=_rubs,
        late=(0.0,) * 7,
        bias=(0.0, 0.0, 0.0, 0.0, 0.0, 0.012, 0.0),
    ),
}


def realized(robot: Supplied, out: Path, *, bare: bool, timestep: float) -> Path:
    """Convert the supplier's URDF to MJCF with position servos; return the file."""
    place = distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data")
    robots = Path(str(place)) / "robots"
    command = [str(Path(sys.executable).with_name("pytest-twin")), "realize"]
    subprocess.run(
        [*command, str(robots / robot.urdf), "--out", str(out)],
        check=True, env={"ROS_PACKAGE_PATH": str(robots)},
    )  # fmt: skip
    (written,) = out.glob("*.xml")
    spec = mujoco.MjSpec.from_file(str(written))
    spec.option.timestep = timestep
    for i, actuator in enumerate(spec.actuators):
        actuator.set_to_position(kp=robot.kp[i], kv=robot.kv[i])
        # The supplier's effort limit is kept; the command is now an angle.
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint = spec.joint(actuator.target)
        joint.armature, joint.damping = robot.armature[i], [robot.damping[i], 0.0, 0.0]
        joint.frictionloss = 0.0 if bare else robot.friction[i]
    spec.compile()
    model = out / "model.xml"
    model.write_text(spec.to_xml())
    return model


def real(robot: Supplied, nominal: Path) -> mujoco.MjModel:
    """Return the model with the hidden effects."""
    spec = mujoco.MjSpec.from_file(str(nominal))
    last = spec.joint(spec.actuators[-1].target)
    kg, away = robot.load
    load = last.parent.add_body(name="load", pos=away * np.array(last.axis))
    load.mass, load.ipos, load.inertia = kg, [0.0, 0.0, 0.0], [4e-4] * 3
    load.explicitinertial = True
    model = spec.compile()
    model.opt.timestep = FINE
    robot.hide(model)
    return model


def commands(robot: Supplied, random: np.random.Generator, *, steps: bool) -> np.ndarray:
    """(n, joints) setpoints, rad: three sines at each joint, with or without steps."""
    time_s = np.arange(0.0, SECONDS, SENT)
    count = (3, len(robot.home))
    rate, size = random.uniform(0.1, 0.9, count), random.uniform(0.05, 0.2, count)
    waves = size[:, None] * np.sin(2 * np.pi * rate[:, None] * time_s[None, :, None])
    moved: np.ndarray = np.array(robot.home) + waves.sum(axis=0)
    if steps:
        moved += 0.1 * np.sign(np.sin(2 * np.pi * 0.35 * time_s))[:, None]
    return moved


def record(
    robot: Supplied, model: mujoco.MjModel, path: Path, role: str, seed: int, *, steps: bool
) -> None:
    """Write one recording."""
    random = np.random.default_rng(seed)
    sent = commands(robot, random, steps=steps)
    names = tuple(model.joint(int(j)).name for j in model.actuator_trnid[:, 0])
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = sent[0]
    mujoco.mj_step(model, data, round(SETTLE / FINE))
    late = np.array(robot.late)
    stamps = np.cumsum(random.uniform(0.004, 0.007, round(SECONDS / 0.004)))
    stamps = stamps[stamps < SECONDS - SENT]
    taken = np.rint(stamps / FINE).astype(int)
    read, at = np.empty((len(taken), len(names))), 0
    for k in range(taken[-1] + 1):
        if at < len(taken) and taken[at] == k:
            read[at], at = data.qpos, at + 1
        held = np.clip(((k * FINE - late) / SENT + 1e-6).astype(int), 0, len(sent) - 1)
        data.ctrl[:] = sent[held, np.arange(len(names))]
        mujoco.mj_step(model, data)
    read += np.array(robot.bias) + NOISE * random.standard_normal(read.shape)
    begin = 1_700_000_000_000_000_000
    seconds = taken * FINE, SENT * np.arange(len(sent))
    states, told = (begin + np.rint(t * 1e9).astype(np.int64) for t in seconds)
    write_recording(
        path,
        [
            JointSeries("/joint_states", names, states, states, read, None, None),
            JointSeries("/joint_commands", names, told, told, sent, None, None),
        ],
        {"role": role},
    )


def main() -> int:
    """Realize, record and diagnose; return the command's exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--robot", choices=sorted(ROBOTS), default="ur5")
    parser.add_argument("--bare", action="store_true", help="no dry friction in the model")
    parser.add_argument("--steps", action="store_true", help="steps of 0.1 rad in two recordings")
    parser.add_argument("--timestep", type=float, default=STEP, help="of the model, s")
    args = parser.parse_args()
    robot, out = ROBOTS[args.robot], args.out
    out.mkdir(parents=True, exist_ok=True)
    nominal = realized(robot, out / "model", bare=args.bare, timestep=args.timestep)
    model = real(robot, nominal)
    files = []
    for i, role in enumerate(ROLES):
        files.append(out / f"{i}_{role}.mcap")
        record(robot, model, files[-1], role, i, steps=args.steps and i in (1, 4))
    print(f"hidden: {robot.truth}", flush=True)
    command = [
        str(Path(sys.executable).with_name("pytest-twin")),
        "diagnose",
        "--seconds",
        "0",
        str(nominal),
    ]
    since = time.monotonic()
    done = subprocess.run([*command, *map(str, files), "--out", str(out / "why")], check=False)
    print(f"{(time.monotonic() - since) / 60.0:.1f} minutes")
    return done.returncode


if __name__ == "__main__":
    sys.exit(main())
