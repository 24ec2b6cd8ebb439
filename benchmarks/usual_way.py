"""Compare parameter fitting only (mujoco.sysid) with the diagnosis on blind cases.

    pip install 'pytest-twin[benchmarks]'
    python benchmarks/usual_way.py --cases DIR --results DIR [--truth DIR] --out FILE [--jobs 2]
    python benchmarks/usual_way.py --delay DIR

For each case mujoco.sysid fits damping, armature, dry friction and servo gains of every joint to
the recordings that the diagnosis fits, from the same initial states. Both are then tested on the
held-out recordings by the RMS position error of each joint; under effort commands in the windows of
the diagnosis. ``--results`` is the output folder of run.py. FILE gets a line of JSON for every
case; a second run continues the first one. The order is independent of the hidden effects.

``--delay`` writes recordings of one servo with a command delay of 20 ms, and prints both results.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.trials import TrialSet, read_trials
from pytest_twin.effects.segment import Segment
from pytest_twin.estimation.hypothesis import EMPTY
from pytest_twin.formats.mcap import TOPICS, JointSeries, write_recording
from pytest_twin.realization import load

Modifier = Callable[[mujoco.MjSpec, sysid.Parameter], None]

# Smallest relative gain of a drive. A drive with gain zero would ignore its commands.
_LEAST = 1e-6


# -- mujoco.sysid on a case


def read_case(model: Path, recordings: list[Path]) -> tuple[Problem, TrialSet]:
    """Return segments, initial states and noise floors of the diagnosis."""
    realization = load(model)
    trials = read_trials(recordings, [], TOPICS, realization.structure)
    return prepare(realization, trials.fit, trials.held_out, threads=1).problem, trials


def held_out_rms(problem: Problem) -> dict[str, float]:
    """RMS errors of the nominal model by joint, rad or m; infinite if it diverged."""
    left = problem.residuals([EMPTY], problem.held_out)[0][:, : len(problem.joints)]
    rms = np.sqrt(np.mean(left**2, axis=0))
    return {
        j: float(r) if np.isfinite(r) else np.inf for j, r in zip(problem.joints, rms, strict=True)
    }


def with_sensors(model: Path, joints: tuple[str, ...]) -> mujoco.MjSpec:
    """Return the model with a position sensor on every joint, which mujoco.sysid compares."""
    spec = mujoco.MjSpec.from_file(str(model))
    for joint in joints:
        spec.add_sensor(
            name=f"encoder_{joint}",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    return spec


def set_joint(joint: str, field: str) -> Modifier:
    """Return a modifier of a joint's parameter, as an array if MuJoCo has a polynomial."""

    def write(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        element = spec.joint(joint)
        now = getattr(element, field)
        if np.ndim(now):
            now[0] = parameter.value[0]
        else:
            setattr(element, field, float(parameter.value[0]))

    return write


def set_gain(actuator: str, mode: str, which: str) -> Modifier:
    """Return a modifier of a servo's stiffness or damping, or of another drive's gain."""

    def write(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        value = float(parameter.value[0])
        element = spec.actuator(actuator)
        if which == "kp":
            element.gainprm[0], element.biasprm[1] = value, -value
        elif mode == "velocity":
            element.gainprm[0], element.biasprm[2] = value, -value
        elif which == "kv":
            element.biasprm[2] = -value
        else:
            element.gainprm[0] = value

    return write


def free_parameters(problem: Problem, model: mujoco.MjModel, *, gains: bool) -> sysid.ParameterDict:
    """Return damping, armature, dry friction and gains of every joint, with bounds."""
    params = sysid.ParameterDict()

    def add(name: str, value: float, upper: float, write: Modifier, lower: float = 0.0) -> None:
        params.add(sysid.Parameter(name, value, lower, max(upper, 3.0 * value), modifier=write))

    scales = problem.scales.of
    for j, joint in enumerate(problem.joints):
        dof = model.joint(joint).dofadr[0]
        effort, speed = float(scales["effort"][j]), float(scales["velocity"][j])
        add(f"{joint} damping", float(np.ravel(model.dof_damping[dof])[0]), 10.0 * effort / speed,
            set_joint(joint, "damping"))  # fmt: skip
        add(f"{joint} armature", float(model.dof_armature[dof]), 5.0 * float(scales["inertia"][j]),
            set_joint(joint, "armature"))  # fmt: skip
        add(f"{joint} frictionloss", float(model.dof_frictionloss[dof]), 5.0 * effort,
            set_joint(joint, "frictionloss"))  # fmt: skip
    for i in range(model.nu if gains else 0):
        name = model.actuator(i).name
        joint = model.joint(int(model.actuator_trnid[i, 0])).name
        mode = problem.simulator.layout.servo[problem.joints.index(joint)]
        stiffness, damping = -model.actuator_biasprm[i, 1], -model.actuator_biasprm[i, 2]
        if mode == "position":
            add(f"{joint} kp", stiffness, 3.0 * stiffness, set_gain(name, mode, "kp"),
                _LEAST * stiffness)  # fmt: skip
            add(f"{joint} kv", damping, 3.0 * damping + 0.1 * stiffness,
                set_gain(name, mode, "kv"))  # fmt: skip
        elif mode == "velocity":
            add(f"{joint} kv", damping, 3.0 * damping, set_gain(name, mode, "kv"),
                _LEAST * damping)  # fmt: skip
        else:
            gain = float(model.actuator_gainprm[i, 0])
            add(f"{joint} gain", gain, 3.0 * gain, set_gain(name, mode, "gain"), _LEAST * gain)
    return params


def sequence(
    name: str, spec: mujoco.MjSpec, segments: list[Segment], joints: tuple[str, ...]
) -> sysid.ModelSequences:
    """Return measured segments for mujoco.sysid; commands are held between stamps."""
    model = spec.compile()
    index = [int(model.joint(j).qposadr[0]) for j in joints]
    speeds = [int(model.joint(j).dofadr[0]) for j in joints]
    drives = [
        joints.index(model.joint(int(model.actuator_trnid[i, 0])).name) for i in range(model.nu)
    ]
    step = model.opt.timestep
    states, controls, sensors = [], [], []
    for s in segments:
        qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
        qpos[index], qvel[speeds] = s.initial_position, s.initial_velocity
        steps = int(np.ceil((s.time[-1] - s.start) / step)) + 1
        at = step * np.arange(steps)
        held = np.searchsorted(s.command_time, s.start + at + 1e-9, side="right") - 1
        states.append(sysid.create_initial_state(model, qpos, qvel))
        controls.append(sysid.TimeSeries(at, s.command[np.maximum(held, 0)][:, drives]))
        sensors.append(sysid.TimeSeries.from_names(s.time - s.start, s.position, model))
    names = [f"{name}_{i}" for i in range(len(segments))]
    return sysid.ModelSequences(name, spec, names, states, controls, sensors)


def fit(
    model: Path, problem: Problem, iterations: int, *, gains: bool
) -> tuple[str, dict[str, Any]]:
    """Fit with mujoco.sysid; return the fitted model (MJCF) and its report."""
    spec = with_sensors(model, problem.joints)
    params = free_parameters(problem, spec.compile(), gains=gains)
    segments = [problem.simulator.segments[i] for i in problem.fit]
    # By default it divides by the norm of each segment; here errors are in noise floors, as in the
    # comparison.
    transform = sysid.SignalTransform(normalize=False)
    floors = zip(problem.joints, problem.floor.tolist(), strict=True)
    transform.set_sensor_weights({f"encoder_{joint}": 1.0 / floor for joint, floor in floors})
    residual = sysid.build_residual_fn(
        models_sequences=[sequence("fit", spec, segments, problem.joints)],
        modify_residual=transform.apply,
        n_threads=1,
    )
    params.move_off_bounds()
    start = time.perf_counter()
    with contextlib.redirect_stdout(sys.stderr):  # its iterations
        best, result = sysid.optimize(
            params, residual, verbose=False, max_iters=iterations, x_scale="jac"
        )
    seconds = time.perf_counter() - start
    left, _, _ = residual(best.as_vector(), best)
    _, half_width = sysid.calculate_intervals(left, result.jac)
    for parameter in best.values():
        parameter.apply_modifier(spec)
    spec.compile()
    values = best.as_vector()
    told = {
        name: {"value": float(v), "ci95": [float(v - w), float(v + w)]}
        for name, v, w in zip(best.keys(), values, half_width, strict=True)
    }
    return spec.to_xml(), {"parameters": told, "seconds": seconds}


def usual(case: Path, iterations: int, *, gains: bool = True) -> dict[str, Any]:
    """Run mujoco.sysid on one case; return held-out errors before and after the fit, rad or m.

    The errors after the fit are infinite if the fit fails.
    """
    recordings = sorted((case / "recordings").glob("*.mcap"))
    problem, _ = read_case(case / "model.xml", recordings)
    before = held_out_rms(problem)
    floor = dict(zip(problem.joints, problem.floor.tolist(), strict=True))
    try:
        xml, told = fit(case / "model.xml", problem, iterations, gains=gains)
    except (ValueError, RuntimeError, np.linalg.LinAlgError, mujoco.FatalError) as error:
        told = {"parameters": {}, "broke": " ".join(str(error).split())}
        after = dict.fromkeys(before, np.inf)
    else:
        with tempfile.TemporaryDirectory() as folder:
            fitted = Path(folder) / "model.xml"
            fitted.write_text(xml)
            after = held_out_rms(read_case(fitted, recordings)[0])
    held_out = {
        j: {"rms_before": before[j], "rms_after": after[j], "floor": floor[j]} for j in before
    }
    return {"case": case.name, "held_out": held_out, **told}


# -- comparison


def removed(held_out: dict[str, dict[str, float]]) -> float | None:
    """Removed share of the explainable squared error, over joints; None without such an error.

    Errors are in noise floors, as in score.py.
    """
    before = after = 0.0
    for joint in held_out.values():
        floor = joint["floor"] ** 2
        before += max(joint["rms_before"] ** 2 - floor, 0.0) / floor
        after += max(joint["rms_after"] ** 2 - floor, 0.0) / floor
    return None if before < 1.0 else 1.0 - after / before


def worst(held_out: dict[str, dict[str, float]]) -> str:
    """Return errors before and after, and noise floor, of the joint with the largest error."""
    joint = max(held_out.values(), key=lambda h: h["rms_before"] / h["floor"])
    return f"{joint['rms_before']:.2g} -> {joint['rms_after']:.2g} ({joint['floor']:.1g})"


def fit_all(cases: list[Path], out: Path, iterations: int, jobs: int) -> None:
    """Append a line for each case, with several parallel jobs."""
    with ProcessPoolExecutor(jobs) as pool:
        running = {pool.submit(usual, case, iterations): case for case in cases}
        try:
            for done in as_completed(running):
                with out.open("a") as file:
                    file.write(json.dumps(done.result()) + "\n")
                print(running[done].name, file=sys.stderr, flush=True)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def lines_of(file: Path) -> list[dict[str, Any]]:
    """Return the lines of a file, by case."""
    told = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    return sorted(told, key=lambda t: str(t["case"]))


def table(fitted: Path, results: Path, truth: Path | None) -> list[str]:
    """Return a table of all cases, then the medians."""
    lines = [
        "| case | hidden | mujoco.sysid, worst joint (floor) | removed | diagnosis | removed |",
        "|---|---|---|---|---|---|",
    ]
    shares: list[tuple[float, float]] = []
    of_effect: dict[str, list[tuple[float, float]]] = {}
    for mine in lines_of(fitted):
        diagnosed = results / mine["case"] / "diagnosis.json"
        hidden = "-"
        if truth is not None:
            said = json.loads((truth / f"{mine['case']}.json").read_text())
            hidden = ", ".join(e["effect"] for e in said["effects"]) or (
                said["outside"]["kind"] if said["outside"] else "nothing"
            )
        usual_share = removed(mine["held_out"])
        cells = [worst(mine["held_out"]), percent(usual_share)]
        if diagnosed.is_file():
            theirs = json.loads(diagnosed.read_text())["held_out"]
            share = removed(theirs)
            cells += [worst(theirs), percent(share)]
            if usual_share is not None and share is not None:
                shares.append((usual_share, share))
                of_effect.setdefault(hidden, []).append((usual_share, share))
        else:
            cells += ["no result", "-"]
        lines.append(f"| {mine['case']} | {hidden} | " + " | ".join(cells) + " |")
    if truth is not None and of_effect:
        lines += [
            "",
            "| hidden | cases | mujoco.sysid, median removed | diagnosis |",
            "|---|---|---|---|",
        ]
        for hidden, pairs in sorted(of_effect.items()):
            medians = " | ".join(percent(m) for m in np.median(np.array(pairs), axis=0))
            lines.append(f"| {hidden} | {len(pairs)} | {medians} |")
    if shares:
        usual_median, median = np.median(np.array(shares), axis=0)
        lines += [
            "",
            f"Median share of the explainable held-out squared error removed, {len(shares)} cases:"
            f" mujoco.sysid {percent(usual_median)}, diagnosis {percent(median)}.",
        ]
    return lines


def percent(share: float | None) -> str:
    """Format the result."""
    if share is None:
        return "nothing to remove"
    return "diverged" if not np.isfinite(share) else f"{share:.1%}"


# -- a servo whose commands arrive late

DELAY, INERTIA, DAMPING, FRICTION, STIFFNESS = 0.02, 0.05, 0.5, 0.05, 110.0
SERVO = f"""<mujoco model="servo">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
      <joint name="joint" axis="0 0 1" damping="{DAMPING}" frictionloss="{FRICTION}"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" contype="0" conaffinity="0" mass="0"/>
    </body>
  </worldbody>
  <actuator><position name="servo" joint="joint" kp="{STIFFNESS}"/></actuator>
</mujoco>
"""


def late_servo(path: Path, role: str, seed: int) -> None:
    """Simulate 12 s of a multisine with a command delay of 20 ms and otherwise nominal parameters.

    The time step is 0.1 ms, dry friction is set-valued; noise is 2e-5 rad at 200 Hz.
    """
    rng = np.random.default_rng(seed)
    step, every = 1e-4, 50
    t = np.arange(0.0, 12.0, 0.005)
    tones, phase = rng.uniform(0.2, 2.5, 5), rng.uniform(0.0, 2 * np.pi, 5)
    sent = 0.2 * np.sin(2 * np.pi * np.outer(t, tones) + phase).sum(axis=1)
    sent *= np.minimum(t, 1.0)
    late = round(DELAY / step)
    target = np.concatenate([np.full(late, sent[0]), np.repeat(sent, every)])
    q = v = 0.0
    position = []
    for k in range(len(t) * every):
        if k % every == 0:
            position.append(q)
        v = (v + step * STIFFNESS * (target[k] - q) / INERTIA) / (1 + step * DAMPING / INERTIA)
        v = np.sign(v) * max(abs(v) - step * FRICTION / INERTIA, 0.0)
        q += step * v
    measured = np.array(position) + 2e-5 * rng.standard_normal(len(position))
    stamp = 1_760_000_000_000_000_000 + np.rint(t * 1e9).astype(np.int64)

    def series(topic: str, values: FloatArray) -> JointSeries:
        return JointSeries(topic=topic, names=("joint",), stamp=stamp, log_time=stamp,
                           position=values[:, None], velocity=None, effort=None)  # fmt: skip

    write_recording(
        path, [series("/joint_states", measured), series("/joint_commands", sent)], {"role": role}
    )


def delay_example(out: Path) -> None:
    """Print both results for a servo with a command delay."""
    recordings = out / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    (out / "model.xml").write_text(SERVO)
    for i, role in enumerate(("fit", "fit", "held_out")):
        late_servo(recordings / f"{i}_multisine.mcap", role, seed=i)
    # The gain is fixed at the firmware's value; without gravity, only the ratio of inertia and gain
    # is identifiable.
    told = usual(out, 30, gains=False)
    print(f"true: commands arrive {DELAY * 1e3:.0f} ms late; damping {DAMPING} N*m*s/rad")
    print("mujoco.sysid:")
    for name, p in told["parameters"].items():
        print(f"  {name}: {p['value']:.4g} ({p['ci95'][0]:.4g} to {p['ci95'][1]:.4g})")
    ratio = told["parameters"]["joint damping"]["value"] / DAMPING
    print(f"  damping {ratio:.1f} times the true one; held out {worst(told['held_out'])} rad")
    why = diagnose(out, out / "why")
    print("pytest-twin diagnose:")
    for finding in why["findings"]:
        for name, p in finding["parameters"].items():
            low, high = p["ci95"]
            print(f"  {finding['effect']} {finding['joint']}, {name}: {p['value']:.4g} "
                  f"{p['unit']} ({low:.4g} to {high:.4g})")  # fmt: skip
    print(f"  verdict {why['verdict']}; held out {worst(why['held_out'])} rad")


def diagnose(case: Path, out: Path) -> dict[str, Any]:
    """Run the command on a case folder."""
    program = str(Path(sys.executable).with_name("pytest-twin"))
    recordings = sorted(map(str, (case / "recordings").glob("*.mcap")))
    subprocess.run(
        [
            program,
            "diagnose",
            "--seconds",
            "0",
            str(case / "model.xml"),
            *recordings,
            "--out",
            str(out),
        ],
        check=False,
        stdout=subprocess.DEVNULL,
    )
    found: dict[str, Any] = json.loads((out / "diagnosis.json").read_text("utf-8"))
    return found


def main() -> None:
    """Fit the cases without a result, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--delay", type=Path, help="write and judge the servo with late commands")
    parser.add_argument("--cases", type=Path)
    parser.add_argument("--results", type=Path, help="what run.py wrote")
    parser.add_argument("--truth", type=Path, help="to name what is hidden")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--iterations", type=int, default=8)
    parser.add_argument("--jobs", type=int, default=2, help="cases at the same time")
    args = parser.parse_args()
    if args.delay is not None:
        delay_example(args.delay)
        return
    known = {told["case"] for told in lines_of(args.out)}
    left = [p for p in sorted(args.cases.iterdir()) if p.is_dir() and p.name not in known]
    random.Random(0).shuffle(left)
    fit_all(left, args.out, args.iterations, args.jobs)
    print("\n".join(table(args.out, args.results, args.truth)))


if __name__ == "__main__":
    main()
