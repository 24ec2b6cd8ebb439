"""EMPS: compare the diagnosis of a carriage whose model has mass only with published figures.

    python benchmarks/real/emps.py --out DIR

The script diagnoses (to DIR/why, unless it exists). It then compares the identified forces with
three others on the held-out run, by the force error (the published metric) and by open-loop
simulation.

Force error: 100 |f - X b| / |f|, X from positions alone. As in the authors' script (Janot, Gautier,
Brunot 2019; Script_IDIM_LS.m in wmkouw/NSI-EMPS): a Butterworth filter of fourth order at 100 Hz
run forwards and backwards, central differences at 1 kHz, the first 50 samples left out, both sides
decimated by ten. These files have every second sample, so positions (cubic) and forces (linear) are
interpolated to 1 kHz first. The time at which a force acts within its millisecond is not recorded
and influences the error, which is therefore given for several shifts.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from recorded import folder_of
from scipy import signal
from scipy.interpolate import CubicSpline

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import PatchedModel
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.trial import Trial, make_trial

Regressor = Callable[[FloatArray, FloatArray], FloatArray]

JOINT = "slide"
NOMINAL_MASS = 95.1
PUBLISHED = {"mass": 95.1089, "viscous": 203.5034, "coulomb": 20.3935, "offset": -3.1648}
STEP = 1e-3
SHIFTS = (0.0, 0.3e-3, 0.5e-3)
WINDOW = 1.0

# Force of motion as a function of velocity and acceleration, linear in the coefficient.
TERMS: Mapping[str, Regressor] = {
    "mass": lambda v, a: a,
    "viscous": lambda v, a: v,
    "coulomb": lambda v, a: np.sign(v),
    "offset": lambda v, a: np.ones_like(v),
    "viscous_difference": lambda v, a: np.abs(v),
    "drag": lambda v, a: v * np.abs(v),
}
# Parameters of findings as coefficients of these terms.
FINDINGS = {
    ("viscous_friction", "coefficient"): "viscous",
    ("coulomb_friction", "coulomb"): "coulomb",
    ("asymmetric_friction", "coulomb"): "coulomb",
    ("asymmetric_friction", "offset"): "offset",
    ("quadratic_drag", "coefficient"): "drag",
    ("directional_viscous_friction", "coefficient"): "viscous",
    ("directional_viscous_friction", "difference"): "viscous_difference",
}


def motion(trial: Trial) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time, velocity and acceleration at 1 kHz from measured positions."""
    time = np.arange(0.0, trial.time[-1], STEP)
    b, a = signal.butter(4, 100.0 * 2.0 * STEP)
    position = signal.filtfilt(b, a, CubicSpline(trial.time, trial.position[:, 0])(time))
    velocity = np.gradient(position, STEP)
    return time, velocity, np.gradient(velocity, STEP)


def decimated(values: FloatArray) -> FloatArray:
    """Decimate (n,) values from 1 kHz to 100 Hz, without the edge."""
    return np.asarray(signal.decimate(values[49:], 10))


def regression(trial: Trial, terms: tuple[str, ...], shift: float) -> tuple[FloatArray, FloatArray]:
    """Return regressors and force, with the force ``shift`` seconds earlier than the motion."""
    time, velocity, acceleration = motion(trial)
    force = np.interp(time - shift, trial.command_time, trial.command[:, 0])
    columns = [decimated(TERMS[t](velocity, acceleration)) for t in terms]
    return np.stack(columns, axis=1), decimated(force)


def least_squares(
    trial: Trial, terms: tuple[str, ...], shift: float
) -> dict[str, tuple[float, float]]:
    """Return an independent estimate: coefficients with standard deviations as by the authors."""
    x, force = regression(trial, terms, shift)
    values = np.linalg.lstsq(x, force, rcond=None)[0]
    spread = (force - x @ values).std() * np.sqrt(np.diag(np.linalg.inv(x.T @ x)))
    return {t: (float(v), float(s)) for t, v, s in zip(terms, values, spread, strict=True)}


def force_error(trial: Trial, values: Mapping[str, float], shift: float) -> float:
    """Relative force error, percent."""
    x, force = regression(trial, tuple(values), shift)
    left = force - x @ np.array(list(values.values()))
    return float(100.0 * np.linalg.norm(left) / np.linalg.norm(force))


def slide(
    values: Mapping[str, float],
    force: FloatArray,
    step: float,
    position: FloatArray,
    velocity: FloatArray,
) -> FloatArray:
    """Positions (steps + 1, runs) of a carriage under forces (steps, runs), from initial states.

    The simulation is independent of the package: semi-implicit steps, set-valued dry friction.
    """
    get = values.get
    mass, coulomb = values["mass"], get("coulomb", 0.0)
    q, v = position.copy(), velocity.copy()
    path = [q]
    for push in force:
        viscous = get("viscous", 0.0) + get("viscous_difference", 0.0) * np.sign(v)
        viscous = viscous + get("drag", 0.0) * np.abs(v)
        free = (v + step * (push - get("offset", 0.0)) / mass) / (1.0 + step * viscous / mass)
        v = np.sign(free) * np.maximum(np.abs(free) - step * coulomb / mass, 0.0)
        q = q + step * v
        path.append(q)
    return np.stack(path)


def open_loop(trial: Trial, values: Mapping[str, float], window: float, start: float) -> FloatArray:
    """(samples, windows) measured minus simulated positions in windows of ``window`` s.

    Each window starts from the measured state. For windows shorter than the run, the part that an
    error of the initial velocity explains is removed, so that the result does not depend on the
    accuracy of the initial state.
    """
    interval = float(np.median(np.diff(trial.time)))
    samples = round(window / interval)
    count = int((trial.duration - start) / window + 1e-6)
    first = round(start / interval) + samples * np.arange(count)
    index = first + np.arange(samples)[:, None]
    fine = round(interval / (STEP / 4))
    step = interval / fine
    commands = np.clip(np.searchsorted(trial.command_time, trial.time, side="right") - 1, 0, None)
    force = np.repeat(trial.command[commands, 0][index], fine, axis=0)
    time, speed, _ = motion(trial)
    q, v = trial.position[first, 0], np.interp(trial.time[first], time, speed)
    path = slide(values, force, step, q, v)[:-1:fine]
    left = trial.position[index, 0] - path
    if count == 1:
        return np.asarray(left)
    nudge = 1e-3
    response = (slide(values, force, step, q, v + nudge)[:-1:fine] - path) / nudge
    shift = (response * left).sum(axis=0) / (response**2).sum(axis=0)
    freed: FloatArray = left - response * shift
    return freed


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def identified(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Return the findings as a force, with the model's mass."""
    values = {"mass": NOMINAL_MASS}
    for finding in diagnosis["findings"]:
        for name, parameter in finding["parameters"].items():
            term = FINDINGS.get((finding["effect"], name))
            if term is None:
                raise SystemExit(f"no force law here for {finding['effect']} {name}")
            values[term] = values.get(term, 0.0) + parameter["value"]
    return values


def main() -> None:
    """Diagnose, compare, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    folder = folder_of("emps")
    why = args.out / "why"
    paths = sorted((folder / "recordings").glob("*.mcap"))
    if not (why / "diagnosis.json").is_file():
        args.out.mkdir(parents=True, exist_ok=True)
        command = [str(Path(sys.executable).with_name("pytest-twin")), "diagnose"]
        command += ["--seconds", "0"]
        subprocess.run(
            [*command, str(folder / "model.xml"), *map(str, paths), "--out", str(why)], check=False
        )
    diagnosis = json.loads((why / "diagnosis.json").read_text("utf-8"))
    print(f"verdict: {diagnosis['verdict']}\n")
    for finding in diagnosis["findings"]:
        for name, p in finding["parameters"].items():
            low, high = p["ci95"]
            print(f"{finding['effect']} {name}: {p['value']:.4g} ({low:.4g} to {high:.4g})")
    recorded = [make_trial(read_recording(path)) for path in paths]
    trials = {t.metadata["role"]: t for t in recorded}
    fit, held_out = trials["fit"], trials["held_out"]

    print("\nIndependent least squares on the inverse dynamics, fit run | held-out run:")
    common = ("mass", "viscous", "coulomb", "offset")
    for terms in (common, (*common, "viscous_difference")):
        for shift in SHIFTS:
            fits = [least_squares(t, terms, shift) for t in (fit, held_out)]
            words = " | ".join(
                ", ".join(f"{t} {v:.2f} +- {s:.2f}" for t, (v, s) in found.items())
                for found in fits
            )
            print(f"  force {shift * 1e3:.1f} ms earlier: {words}")

    found_values = identified(diagnosis)
    models = {
        "mass only": {"mass": NOMINAL_MASS},
        "published": PUBLISHED,
        "diagnosed": found_values,
        "diagnosed, offset as published": {**found_values, "offset": PUBLISHED["offset"]},
        "least squares, one viscous coefficient each way": {
            t: v for t, (v, _) in least_squares(fit, (*common, "viscous_difference"), 0.0).items()
        },
    }
    print("\nHeld-out run: force error in % for a force that acts 0 / 0.3 / 0.5 ms later;")
    print("open-loop rms over the whole run, and in windows of 1 s with their start free:")
    for name, values in models.items():
        errors = " / ".join(f"{force_error(held_out, values, s):.2f}" for s in SHIFTS)
        whole = rms(open_loop(held_out, values, held_out.duration, 0.0))
        pieces = rms(open_loop(held_out, values, WINDOW, 0.0))
        print(f"  {name}: {errors} %; {1e3 * whole:.3g} mm, {1e3 * pieces:.3g} mm")
    patched = load_model(find_model(why))
    outside_mjcf = patched.patched or PatchedModel((JOINT,))
    predicted = replay_patched(patched.realization, outside_mjcf, [held_out], threads=1)[0]
    off = 1e3 * rms(predicted.position - held_out.position)
    print(f"  the patched model, replayed by the package: {off:.3g} mm over the whole run")
    error = diagnosis["held_out"][JOINT]
    before, after, floor = (1e3 * error[k] for k in ("rms_before", "rms_after", "floor"))
    print(f"  as the diagnosis reports it, windows of 1 s: {before:.3g} -> {after:.3g} mm "
          f"(floor {floor:.2g} mm)")  # fmt: skip


if __name__ == "__main__":
    main()
