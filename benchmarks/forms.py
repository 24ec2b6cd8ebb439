"""Diagnose effects that are implemented by laws of textbooks and other simulators.

    python benchmarks/forms.py --out DIR [FORM ...]

An arm of three joints is simulated by MuJoCo with a tenth of the model's time step; its drives are
computed here. Every form changes the drive, the joint or the reading of one joint. Some use the law
of a textbook or simulator for an effect of the catalogue; for the others the catalogue has no law.
Three recordings of each (the last is held out) are diagnosed by ``pytest-twin diagnose``. A line
states the hidden form, the findings, and the held-out error before and after. The exit status is 1
if a form of the catalogue is not named correctly and alone, or if another form is named.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import mujoco
import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.mcap import JointSeries, write_recording

JOINTS = ("yaw", "lift", "elbow")
KP, KV = np.array([60.0, 80.0, 25.0]), np.array([3.0, 3.0, 0.8])
STEP, FINER, SECONDS, SETTLED = 0.002, 10, 6.0, 1.0
COMMANDS, STATES, NOISE = 100, 200, 1e-4
"""Rates of commands and states, Hz, and standard deviation of the encoder noise, rad."""
HERE = 1
"""Index of the joint with the hidden form: the lift."""
START_NS = 1_700_000_000_000_000_000

_SERVOS = "".join(
    f'<position joint="{j}" kp="{p}" kv="{v}"/>' for j, p, v in zip(JOINTS, KP, KV, strict=True)
)
MODEL = f"""\
<mujoco><compiler angle="radian"/><option timestep="{STEP}" integrator="implicitfast"/>
<default><geom type="capsule" size=".02" contype="0" conaffinity="0"/></default><worldbody>
<body><joint name="yaw" axis="0 0 1" damping=".6" armature=".03"/>
<geom fromto="0 0 0 .3 0 .05" mass="1.2"/>
<body pos=".3 0 .05"><joint name="lift" axis="0 1 0" damping=".3" armature=".02"/>
<geom fromto="0 0 0 .25 0 0" mass=".7"/>
<body pos=".25 0 0"><joint name="elbow" axis="0 1 0" damping=".1" armature=".01"/>
<geom fromto="0 0 0 .15 0 0" mass=".3"/>
</body></body></body></worldbody><actuator>{_SERVOS}</actuator></mujoco>
"""


class Form:
    """One implementation of a law. Efforts are in N*m; ``t`` is the time since the start, s.

    Attributes:
        named: effect of the catalogue that it implements; None if the catalogue has none.
        joint: its joint; None for the whole robot.
        shows: index of the joint whose reading it changes most.
        gearing: (joints, joints) matrix from joint to motor positions, which the servos control.
        arm: MJCF of the arm, if it differs from the model's.
    """

    named: ClassVar[str | None] = None
    joint: ClassVar[str | None] = JOINTS[HERE]
    shows: ClassVar[int] = HERE
    gearing: ClassVar[FloatArray] = np.eye(len(JOINTS))
    arm: ClassVar[str] = MODEL
    temperature: str | None = None

    def __init__(self, trial: int) -> None:
        self.trial = trial

    def links(self, model: mujoco.MjModel) -> None:
        """Return the model of the links."""

    def setpoint(self, command: float, step: float) -> float:
        """Return the setpoint that the servo uses for a command."""
        return command

    def delivered(self, effort: FloatArray) -> float:
        """Return the effort of the drive, from the demands of all drives."""
        return float(effort[HERE])

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        """Return the effort in addition to the drive's."""
        return 0.0

    def read(self, q: FloatArray) -> FloatArray:
        """Return the encoder readings."""
        return q


def _dry(level: float, v: float) -> float:
    return -level * float(np.tanh(v / 0.01))


class Smoothed(Form):
    """The command is low-passed before the servo, as by MuJoCo's ``timeconst``."""

    named, _seen = "actuator_lag", None

    def setpoint(self, command: float, step: float) -> float:
        seen = command if self._seen is None else self._seen
        self._seen = seen - (command - seen) * float(np.expm1(-step / 0.03))
        return self._seen


class SmallEfforts(Form):
    """A drive with a dead zone of 1 N*m, which is subtracted from larger efforts."""

    named = "dead_zone"

    def delivered(self, effort: FloatArray) -> float:
        asked = float(effort[HERE])
        return float(np.sign(asked)) * max(abs(asked) - 1.0, 0.0)


class SlewedEffort(Form):
    """A drive whose effort changes by at most 40 N*m/s."""

    named, _gives = "rate_limit", None

    def delivered(self, effort: FloatArray) -> float:
        asked, most = float(effort[HERE]), 40.0 * STEP / FINER
        held = asked if self._gives is None else self._gives
        self._gives = held + float(np.clip(asked - held, -most, most))
        return self._gives


class FrictionByDrive(Form):
    """Dry friction of a worm gear, proportional to the motor effort."""

    named = "load_dependent_friction"

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return _dry(0.15 * abs(delivered), v)


class FourWaves(Form):
    """Dry friction with four maxima per revolution."""

    named = "position_dependent_friction"

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return _dry(0.4 * (1.0 + 0.8 * np.sin(4.0 * q + 0.4)), v)


class SevenWaves(Form):
    """Dry friction with seven maxima per revolution."""

    named = "position_dependent_friction"

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return _dry(0.4 * (1.0 + 0.8 * np.sin(7.0 * q + 0.4)), v)


class ManySlots(Form):
    """Cogging with 84 periods per revolution of the joint."""

    named = "cogging"

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return 0.4 * float(np.sin(84.0 * q + 0.5))


class WarmsUp(Form):
    """Dry friction that decays within three seconds."""

    named = "thermal_friction"

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return _dry(0.8 * float(np.exp(-max(t, 0.0) / 3.0)), v)


class Grease(Form):
    """Viscous friction that vanishes at high ambient temperature."""

    named = "thermal_friction"
    _rooms = (("10 C", 0.9), ("40 C", 0.0), ("25 C", 0.45))

    def __init__(self, trial: int) -> None:
        super().__init__(trial)
        self.temperature, self._coefficient = self._rooms[trial]

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return -self._coefficient * v


class WheelOffItsAxis(Form):
    """An eccentric code wheel with a phase and an offset at zero."""

    named = "encoder_eccentricity"

    def read(self, q: FloatArray) -> FloatArray:
        out = q.copy()
        out[HERE] += 0.02 * np.sin(q[HERE] + 0.7)
        return out


class HeavyLink(Form):
    """A link with a wrong mass and the nominal inertia: ``body_mass`` times 1.4."""

    named = "inertial_parameters"

    def links(self, model: mujoco.MjModel) -> None:
        model.body_mass[model.jnt_bodyid[HERE]] *= 1.4


class WideLink(Form):
    """A link with the nominal mass and a wrong inertia: ``body_inertia`` times 4."""

    named = "inertial_parameters"

    def links(self, model: mujoco.MjModel) -> None:
        model.body_inertia[model.jnt_bodyid[HERE]] *= 4.0


class MovedCentre(Form):
    """A link with a wrong centre of mass."""

    named = "inertial_parameters"

    def links(self, model: mujoco.MjModel) -> None:
        model.body_ipos[model.jnt_bodyid[HERE]] += (0.03, 0.0, 0.02)


class OtherLink(Form):
    """A link with wrong mass, inertia and centre of mass."""

    named = "inertial_parameters"

    def links(self, model: mujoco.MjModel) -> None:
        body = model.jnt_bodyid[HERE]
        model.body_mass[body] *= 1.25
        model.body_inertia[body] *= 2.0
        model.body_ipos[body] += (0.02, 0.0, -0.02)


class LoadAside(Form):
    """An eccentric payload on the last link: a ball of 200 g at (12, 4, -6) cm."""

    named, joint, shows = "payload", None, 2
    arm = MODEL.replace(
        "</body></body></body>",
        '<geom type="sphere" size=".01" pos=".12 .04 -.06" mass=".2"/></body></body></body>',
    )


class OtherDrive(Form):
    """The drive of the next joint also acts on this one."""

    named = "joint_coupling"

    def delivered(self, effort: FloatArray) -> float:
        return float(effort[HERE] + 0.3 * effort[HERE + 1])


class Differential(Form):
    """A belt over the preceding joint: its rotation also rotates this link."""

    named = "joint_coupling"
    gearing = np.array([[1.0, 0.0, 0.0], [-0.1, 1.0, 0.0], [0.0, 0.0, 1.0]])


class OtherReading(Form):
    """The encoder of the next joint also rotates with this one."""

    named = "joint_coupling"
    joint = JOINTS[HERE + 1]
    shows = HERE + 1

    def read(self, q: FloatArray) -> FloatArray:
        out = q.copy()
        out[self.shows] += 0.02 * q[HERE]
        return out


class Pulses(Form):
    """A force pulse every two seconds."""

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return 2.0 * (t % 2.0 > 1.6)


class Shaker(Form):
    """An oscillating force."""

    def push(self, t: float, q: float, v: float, delivered: float) -> float:
        return float(np.sin(2.0 * np.pi * 0.7 * t))


FORMS: tuple[type[Form], ...] = (
    Smoothed, SmallEfforts, SlewedEffort, FrictionByDrive, FourWaves, SevenWaves, ManySlots,
    WarmsUp, Grease, WheelOffItsAxis,
    HeavyLink, WideLink, MovedCentre, OtherLink, LoadAside,
    OtherDrive, Differential, OtherReading, Pulses, Shaker,
)  # fmt: skip


def command_at(t: float, trial: int) -> FloatArray:
    """(joints,) rad: three sines each, from rest."""
    random = np.random.default_rng(trial + 1)
    frequency, phase = random.uniform(0.3, 1.6, (3, 3)), random.uniform(0.0, 2.0 * np.pi, (3, 3))
    since = max(t, 0.0)
    wave = 0.3 * np.sin(2.0 * np.pi * frequency * since + phase).sum(axis=0)
    out: FloatArray = wave * min(2.0 * since, 1.0)
    return out


def record(file: Path, form: Form) -> None:
    """Simulate the arm and write a recording."""
    model = mujoco.MjModel.from_xml_string(form.arm)
    model.actuator_gainprm[:], model.actuator_biasprm[:] = 0.0, 0.0
    step = model.opt.timestep = STEP / FINER
    data = mujoco.MjData(model)
    form.links(model)
    mujoco.mj_setConst(model, data)
    sent_at, sent, seen_at, seen = [], [], [], []
    per_command, per_state = (round(1.0 / rate / step) for rate in (COMMANDS, STATES))
    command = command_at(-SETTLED, form.trial)
    for k in range(-round(SETTLED / step), round(SECONDS / step)):
        t = k * step
        if k % per_command == 0:
            command = command_at(t, form.trial)
            if k >= 0:
                sent_at.append(t)
                sent.append(command)
        if k >= 0 and k % per_state == 0:
            seen_at.append(t)
            seen.append(form.read(data.qpos.copy()))
        target = command.copy()
        target[HERE] = form.setpoint(command[HERE], step)
        motors, speeds = form.gearing @ data.qpos, form.gearing @ data.qvel
        effort = KP * (target - motors) - KV * speeds
        q, v = float(data.qpos[HERE]), float(data.qvel[HERE])
        effort[HERE] = form.delivered(effort)
        effort = form.gearing.T @ effort
        effort[HERE] += form.push(t, q, v, float(effort[HERE]))
        data.qfrc_applied[:] = effort
        mujoco.mj_step(model, data)
    noise = NOISE * np.random.default_rng([form.trial, 7]).standard_normal((len(seen), 3))
    told = {"role": "held_out" if form.trial == 2 else "fit"}
    if form.temperature is not None:
        told["temperature"] = form.temperature
    commands, states = (
        START_NS + np.rint(np.array(at) * 1e9).astype(np.int64) for at in (sent_at, seen_at)
    )
    write_recording(
        file,
        [
            JointSeries("/joint_commands", JOINTS, commands, commands, np.array(sent), None, None),
            JointSeries(
                "/joint_states", JOINTS, states, states, np.array(seen) + noise, None, None
            ),
        ],
        told,
    )


def diagnosed(folder: Path, form: type[Form]) -> tuple[bool, str]:
    """Record and diagnose by the command line; return whether it is right, and a line of output."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(MODEL)
    files = [folder / f"{i}.mcap" for i in range(3)]
    for i, file in enumerate(files):
        record(file, form(i))
    words = [
        "pytest_twin.cli",
        "diagnose",
        "--seconds",
        "0",
        folder / "model.xml",
        *files,
        "--out",
        folder / "why",
    ]
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        return False, f"{form.__name__}: {done.stderr.strip()}"
    said = json.loads((folder / "why" / "diagnosis.json").read_text())
    names = [(f["effect"], f["joint"]) for f in said["findings"]]
    wanted = [] if form.named is None else [(form.named, form.joint)]
    error = said["held_out"][JOINTS[form.shows]]
    named = ", ".join(f"{e} at {j}" for e, j in names) or "nothing"
    return names == wanted, (
        f"{form.__name__}: {form.named or 'in no catalogue'}; {said['verdict']}, named {named}; "
        f"{1e3 * error['rms_before']:.2f} -> {1e3 * error['rms_after']:.2f} mrad "
        f"(floor {1e3 * error['floor']:.2f})"
    )


def main() -> int:
    """Run; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("forms", metavar="FORM", nargs="*", help="all by default")
    parser.add_argument("--out", type=Path, required=True, help="folder of cases and diagnoses")
    args = parser.parse_args()
    known = {f.__name__: f for f in FORMS}
    if unknown := set(args.forms) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(known)}")
    right = True
    for name in args.forms or known:
        good, line = diagnosed(args.out / name, known[name])
        right &= good
        print("right" if good else "WRONG", line, flush=True)
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
