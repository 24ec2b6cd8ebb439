"""Drawn arms that are driven by motion from ``pytest-twin excite``, and then identified.

    python benchmarks/identification/excited_cells.py [--arms N]

``pytest-twin excite`` designs motion for the nominal arm within approved limits. MuJoCo drives arms
with other parameters under these commands, in the closed loop of their servos; neither design nor
identification sees these parameters. Positions have noise, and efforts have noise that is
correlated over 20 ms. Every other arm has an encoder whose zero and one whose scale are off. The
recordings to fit and to hold out are those that ``excite`` proposes for each.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import yaml
from coverage_of_intervals import EncoderErrors, covered, effort_noise
from scipy.stats import norm

from pytest_twin import cli
from pytest_twin.identification.effort.identify_effort import EffortResult, identify_effort
from pytest_twin.identification.measured_recordings import MeasuredRecordings, read_measured
from pytest_twin.identification.regressor import Regressor
from pytest_twin.realization import load
from pytest_twin.recording_options import NO_OPTIONS
from pytest_twin.signals import NO_SIGNALS
from pytest_twin.twin import DEFAULT_TOPICS

sys.path.append(str(Path(__file__).parents[1]))
from drawn_arms import JOINTS, LINKS, nominal_parameters, true_parameters

SERVOS = (("shoulder", 4000, 200, 150), ("elbow", 2000, 100, 60), ("wrist", 500, 20, 25))
"""Joint, kp (N m/rad), kv (N m s/rad), greatest effort (N m)."""
MODEL = f"""<mujoco model="arm"><compiler angle="radian"/>
<option timestep="0.001" integrator="Euler"><flag eulerdamp="disable"/></option><worldbody>{
    LINKS
}</worldbody>
<actuator>{
    "".join(
        f'<position joint="{name}" kp="{kp}" kv="{kv}" forcerange="-{most} {most}"/>'
        for name, kp, kv, most in SERVOS
    )
}</actuator></mujoco>"""
EVERY = 5
"""Steps of 1 ms between two samples of a recording."""


def designed(folder: Path) -> list[Path]:
    """The command files that ``pytest-twin excite`` writes for the nominal arm."""
    (folder / "arm.xml").write_text(MODEL.format(**nominal_parameters()))
    joints = {
        name: {"position": [-1.5, 1.5], "velocity": 2.5, "acceleration": 8.0,
               "effort": 0.8 * most, "start": 0.0}
        for name, _, _, most in SERVOS
    }  # fmt: skip
    approved = {
        "approved_by": "drawn", "mechanisms": ["friction", "gravity", "inertia"],
        "duration": 12.0, "rate": 100.0, "task_band": [0.1, 1.0], "joints": joints,
        "workspace": [], "clearance": "none", "supply": {"voltage": 48, "current": 40},
        "stop": {"category": 1, "reaction": 0.1, "plan": "drawn"},
    }  # fmt: skip
    text = yaml.safe_dump({"model": "arm.xml", "excitation": approved})
    (folder / "twin.yaml").write_text(text)
    cli.main(["excite", str(folder / "twin.yaml"), "--out", str(folder / "excitation")])
    return sorted((folder / "excitation" / "trajectories").glob("*.csv"))


def driven(
    model: mujoco.MjModel,
    commands: Path,
    out: Path,
    encoders: EncoderErrors,
    random: np.random.Generator,
) -> None:
    """A recording of an arm whose servos follow the commands of a file."""
    with commands.open() as lines:
        rows = list(csv.DictReader(lines))
    stamps = np.array([float(row["time"]) for row in rows])
    wanted = np.array([[float(row[f"{name}.command"]) for name in JOINTS] for row in rows])
    steps = round(stamps[-1] / model.opt.timestep)
    data = mujoco.MjData(model)
    data.qpos[:] = wanted[0]
    q, effort, command = [], [], []
    for step in range(steps):
        now = [np.interp(data.time, stamps, column) for column in wanted.T]
        data.ctrl[:] = now
        before = data.qpos.copy()
        mujoco.mj_step(model, data)
        if step % EVERY == 0:
            # The force of a step belongs to the state before it.
            q.append(before)
            effort.append(data.qfrc_actuator.copy())
            command.append(now)
    rate = 1.0 / (EVERY * model.opt.timestep)
    spread = 0.01 * np.array([most for *_, most in SERVOS])
    measured = np.array(effort) + spread * effort_noise((len(q), len(JOINTS)), rate, random)
    seen = encoders.readings(np.array(q), random)
    heads = [f"{name}.{what}" for what in ("position", "effort", "command") for name in JOINTS]
    table = np.column_stack([np.arange(len(q)) / rate, seen, measured, command])
    np.savetxt(out, table, delimiter=",", fmt="%.9g", header=",".join(["time", *heads]),
               comments="")  # fmt: skip


def identified(
    seed: int, commands: list[Path], folder: Path
) -> tuple[EffortResult, np.ndarray, EncoderErrors]:
    """The identification of one arm, its true base parameters, and the errors of its encoders."""
    random = np.random.default_rng([seed, 56])
    (folder / "real.xml").write_text(MODEL.format(**true_parameters(random)))
    real = load(folder / "real.xml")
    encoders = EncoderErrors.drawn(random) if seed % 2 else EncoderErrors()
    nominal = load(commands[0].parents[2] / "arm.xml")
    fit, held_out = [], []
    for file in commands:
        driven(real.model, file, folder / file.name, encoders, random)
        measured = read_measured(
            folder / file.name, nominal, DEFAULT_TOPICS, NO_OPTIONS, NO_SIGNALS
        )
        (held_out if "held_out" in file.stem else fit).extend(measured)
    result = identify_effort(nominal, MeasuredRecordings(tuple(fit), tuple(held_out)), NO_SIGNALS)
    return result, result.base.values(Regressor(real, JOINTS).prior), encoders


def wrong_stages(result: EffortResult, true: np.ndarray) -> list[str]:
    """Accepted stages one of whose parameters lies outside their joint 95 % interval."""
    off = np.abs(result.fitted.solution.values - true[result.fitted.kept])
    relative = off / result.fitted.solution.half_width * norm.ppf(0.975)
    stages = np.array([result.stage_of[k] for k in result.fitted.kept])
    found = []
    for stage in result.stages:
        own = relative[stages == stage.name]
        # Bonferroni: all parameters of the stage together.
        joint = norm.ppf(1.0 - 0.025 / max(len(own), 1))
        if stage.state == "accepted" and own.max(initial=0.0) > joint:
            found.append(stage.name)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", type=int, default=20)
    args = parser.parse_args()
    inside: dict[str, list[bool]] = {"sound encoders": [], "encoders off": []}
    of_encoders: list[bool] = []
    held, nominal, consistent = [], [], 0
    states: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as design:
        commands = designed(Path(design))
        print(f"{len(commands)} motions designed")
        for seed in range(args.arms):
            with tempfile.TemporaryDirectory() as scratch:
                result, true, encoders = identified(seed, commands, Path(scratch))
            case = "encoders off" if np.any(encoders.scale) else "sound encoders"
            hit, wrong_here = covered(result, true), wrong_stages(result, true)
            inside[case] += hit.tolist()
            of_encoders += [
                abs(one.value - encoders.true_of(one.joint, one.kind)) <= one.half_width
                for one in result.encoders.readings
            ]
            consistent += result.physical.is_consistent
            held += [error.relative for error in result.errors.values()]
            nominal += [error.relative for error in result.nominal.values()]
            states.update(f"{one.name} {one.state}" for one in result.stages)
            wrong.update(wrong_here)
            print(seed, case, f"{np.mean(hit):.2f}", wrong_here, flush=True)
    print(f"{args.arms} arms")
    for case, holds in inside.items():
        print(f"coverage, {case}: {100 * np.mean(holds):.1f} % of {len(holds)} (goal: 90 to 99 %)")
    print(f"coverage of encoders: {100 * np.mean(of_encoders):.1f} % of {len(of_encoders)}")
    print(f"physically consistent: {consistent} of {args.arms} (goal: all)")
    print(f"held-out effort error: median {100 * np.median(held):.2f} %, nominal model "
          f"{100 * np.median(nominal):.1f} %")  # fmt: skip
    print(f"stages: {dict(states)}")
    print(f"accepted stages with a parameter outside their joint interval: {dict(wrong) or 'none'}")


if __name__ == "__main__":
    main()
