"""XL330: a pendulum on a position servo at four firmware gains, one gain held out.

    python benchmarks/real/xl330.py --out DIR [--gains 400 | 100 200 400 800] [--structure]

For each held-out gain, the mean absolute position error of each of its logs is printed in mrad, for
the data sheet's model and for the diagnosis from the other three gains (stored in
DIR/without_GAIN). With --structure it is also printed for a given structure: the effects below,
with parameters that an evolution strategy fits within the ranges below to the logs of the other
three gains (stored in DIR/structure_without_GAIN.json). The last column is the mean over the three
logs other than `lift_and_drop`, which is the published figure. The end of a slide depends on small
differences, so the same figure is given for models whose parameters differ by a few per cent.

The structure has the known effects of such a servo: motor constant, back-EMF, torque roll-off with
current, friction that depends on motor effort and speed, load-dependent friction, dry and viscous
friction, rotor inertia, base tilt, command delay, and torque off after the end of the command of
`lift_and_drop`.
"""

from __future__ import annotations

import argparse
import copy
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cma
import numpy as np
from numpy.typing import NDArray
from recorded import folder_of

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis.patched.model import AppliedEffect, PatchedModel
from pytest_twin.diagnosis.patched.replay import replay_patched
from pytest_twin.diagnosis.prepare import prepare
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Term
from pytest_twin.formats.mcap import read_recording
from pytest_twin.loaded_model import find_model, load_model
from pytest_twin.realization import Realization
from pytest_twin.trial import Trial, make_trial

GAINS = (100, 200, 400, 800)
# Number of searches, and of generations after which only the best search continues.
STARTS, IN_RACE = 4, 110
# Number of neighbouring models, and relative standard deviation of their parameters.
NEIGHBOURS, NEARBY = 24, 0.03
LOGS = ("sin_sin", "sin_time_square", "up_and_down", "lift_and_drop")

# Effect -> parameter -> search range (low, high), SI units; equal values fix the parameter.
# The data sheet's damping of the joint, 0.052 N m s/rad, is back-EMF.
STRUCTURE: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "armature": {"inertia": (-0.001, 0.003)},
    "base_tilt": {"roll": (0.0, 0.0), "pitch": (-0.06, 0.06)},
    "command_delay": {"delay": (0.0, 0.015)},
    "coulomb_friction": {"coulomb": (0.0005, 0.1)},
    "load_dependent_friction": {"coefficient": (0.0, 0.4), "of_drive": (0.0, 0.0)},
    "motor_load_friction": {
        "coefficient": (0.0, 0.6), "stiction_excess": (0.0, 0.5), "stribeck_velocity": (0.02, 4.0),
    },
    "torque_constant": {"relative_error": (-0.4, 1.0)},
    "torque_rolloff": {"inverse_knee": (0.1, 10.0), "back_emf": (0.02, 0.1)},
    "viscous_friction": {"coefficient": (-0.02, 0.04)},
    "watchdog_timeout": {"inverse_timeout": (138.0, 138.0), "back_emf": (0.03, 0.07)},
}  # fmt: skip


def structure(problem: Problem, share: FloatArray) -> Hypothesis:
    """Return the structure at positions ``share`` in its ranges (logarithmic if positive)."""
    terms: list[Term] = []
    theta: list[float] = []
    at = 0
    for effect, ranges in STRUCTURE.items():
        law = catalogue()[effect]
        terms.append(Term(effect, -1 if law.scope == "robot" else 0))
        for p in law.parameters:
            low, high = ranges[p.name]
            value = low
            if high > low:
                part = float(share[at])
                value = low * (high / low) ** part if low > 0.0 else low + part * (high - low)
                at += 1
            theta.append(value / problem.scales.value(p, 0))
    return Hypothesis(tuple(terms), np.array(theta))


def free_parameters() -> int:
    """Number of free parameters."""
    return sum(high > low for each in STRUCTURE.values() for low, high in each.values())


def absolute_errors(
    problem: Problem, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
) -> FloatArray:
    """(hypotheses, segments) mean absolute errors of position, rad; large where it diverged."""
    found = problem.predict(hypotheses, segments)
    measured = [problem.simulator.segments[s].position for s in segments]
    errors = [
        [np.abs(p.position - q).mean() for p, q in zip(each, measured, strict=True)]
        for each in found
    ]
    return np.nan_to_num(np.array(errors), nan=10.0)


def strategy_of(
    cost: Callable[[FloatArray], FloatArray], size: int, seed: int
) -> cma.CMAEvolutionStrategy:
    """Minimize over the unit cube by CMA-ES, from the best of random points.

    Args:
        cost: function from (n, size) points to costs.
        size: number of parameters.
        seed: seed of all draws.
    """
    random = np.random.default_rng(seed)
    count = 2 * int(np.ceil(4 + 3 * np.log(size)))
    first = random.uniform(0.05, 0.95, (6 * count, size))
    return cma.CMAEvolutionStrategy(
        first[cost(first).argmin()],
        0.2,
        {
            "bounds": [0.0, 1.0],
            "popsize": count,
            "seed": np.nan,
            "randn": lambda *shape: random.standard_normal(shape),
            "verbose": -9,
        },
    )


def evolve(
    strategy: cma.CMAEvolutionStrategy,
    cost: Callable[[FloatArray], FloatArray],
    generations: int,
) -> None:
    """Run more generations until there is no improvement."""
    for _ in range(generations):
        if strategy.stop():
            break
        points = strategy.ask()
        strategy.tell(points, list(cost(np.array(points))))
    print(f"  {strategy.countiter}: {1e3 * strategy.best.f:.1f} mrad", file=sys.stderr, flush=True)


def coarse(problem: Problem) -> Problem:
    """Return the problem with a time step of 2 ms for the search."""
    segments = []
    for s in problem.simulator.segments:
        model = copy.copy(s.model)
        model.opt.timestep = 0.002
        segments.append(replace(s, model=model))
    simulator = BatchSimulator(segments, problem.joints, threads=1)
    return replace(problem, simulator=simulator)


def fit_structure(problem: Problem, generations: int, seed: int) -> Hypothesis:
    """Fit the structure: smallest mean absolute error over the fitted logs."""
    quick = coarse(problem)

    def cost(shares: FloatArray) -> FloatArray:
        each = [structure(quick, s) for s in shares]
        errors = absolute_errors(quick, each, quick.fit)
        # The cost combines mean and RMS over the logs, so that no log is neglected.
        value: FloatArray = errors.mean(axis=1) + 0.3 * np.sqrt((errors**2).mean(axis=1))
        return value / 1.3

    # Stick-slip causes several minima; the best of several searches is used.
    searches = [strategy_of(cost, free_parameters(), seed + k) for k in range(STARTS)]
    race = min(IN_RACE, generations)
    for each in searches:
        evolve(each, cost, race)
    deepest = min(searches, key=lambda each: float(each.best.f))
    evolve(deepest, cost, generations - race)
    return structure(problem, np.asarray(deepest.best.x))


def recordings(realization: Realization, gains: Sequence[int]) -> list[Trial]:
    """Return every log of the given gains."""
    folder = folder_of("xl330") / "recordings"
    names = [f"kp{gain}_{log}.mcap" for gain in gains for log in LOGS]
    return [make_trial(read_recording(folder / n), realization.structure) for n in names]


def neighbours(patched: PatchedModel) -> list[PatchedModel]:
    """Return the same effects with independent random changes of every value."""
    random = np.random.default_rng(0)

    def off(effect: AppliedEffect) -> AppliedEffect:
        draws = 1.0 + NEARBY * random.standard_normal(len(effect.values))
        values = zip(effect.values.items(), draws, strict=True)
        return replace(effect, values={name: value * draw for (name, value), draw in values})

    return [
        replace(patched, effects=tuple(e if e.is_in_mjcf else off(e) for e in patched.effects))
        for _ in range(NEIGHBOURS)
    ]


def diagnosed(out: Path, gain: int, seconds: float) -> tuple[str, FloatArray, FloatArray]:
    """Return verdict and findings as text, and errors on the held-out gain.

    The errors are those of each log, and of each neighbouring model, (neighbours, logs).
    """
    why = out / f"without_{gain}"
    folder = folder_of("xl330")
    paths = {g: [folder / "recordings" / f"kp{g}_{log}.mcap" for log in LOGS] for g in GAINS}
    if not (why / "diagnosis.json").is_file():
        command = [str(Path(sys.executable).with_name("pytest-twin")), "diagnose"]
        command += ["--seconds", f"{seconds:g}"]
        fit = [str(p) for g in GAINS if g != gain for p in paths[g]]
        held_out = [str(p) for p in paths[gain]]
        subprocess.run(
            [*command, str(folder / "twin.yaml"), *fit, "--held-out", *held_out, "--out", str(why)],
            check=False,
        )
    diagnosis = json.loads((why / "diagnosis.json").read_text("utf-8"))
    words = [diagnosis["verdict"]]
    for finding in diagnosis["findings"]:
        values = ", ".join(
            f"{name} {p['value']:.3g} {p['unit']}" for name, p in finding["parameters"].items()
        )
        words.append(f"{finding['effect']} ({values})")
    loaded = load_model(find_model(why))
    patched = loaded.patched or PatchedModel(("pendulum",))
    trials = recordings(loaded.realization, [gain])

    def errors(each: PatchedModel) -> list[float]:
        predicted = replay_patched(loaded.realization, each, trials, threads=1)
        pairs = zip(predicted, trials, strict=True)
        return [float(np.abs(p.position - t.position).mean()) for p, t in pairs]

    near = np.array([errors(each) for each in neighbours(patched)])
    return "; ".join(words), np.array(errors(patched)), near


def given(problem: Problem, path: Path, generations: int, seed: int) -> Hypothesis:
    """Return the fitted structure, from an earlier run if there is one."""
    if path.is_file():
        start = structure(problem, np.zeros(free_parameters()))
        return start.with_theta(np.array(json.loads(path.read_text("utf-8"))["theta"]))
    found = fit_structure(problem, generations, seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"theta": found.theta.tolist(), "seed": seed}), "utf-8")
    return found


def row(name: str, errors: FloatArray) -> str:
    """One line of the table: three logs, `lift_and_drop`, and the mean over the three."""
    return (
        f"| {name} | " + " | ".join(f"{1e3 * e:.1f}" for e in [*errors, errors[:3].mean()]) + " |"
    )


def main() -> None:
    """Diagnose, fit, replay, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--gains", type=int, nargs="+", default=[400], choices=GAINS)
    parser.add_argument(
        "--seconds", type=float, default=0.0, help="of each diagnosis; 0: as long as it takes"
    )
    parser.add_argument("--no-diagnosis", action="store_true", help="without pytest-twin diagnose")
    parser.add_argument("--structure", action="store_true", help="fit the structure that is given")
    parser.add_argument("--generations", type=int, default=170)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    realization = load_model(folder_of("xl330") / "twin.yaml").realization
    for gain in args.gains:
        fit = recordings(realization, [g for g in GAINS if g != gain])
        problem = prepare(realization, fit, recordings(realization, [gain]), threads=1).problem
        # The errors are a hundred times the integration error, which is therefore not measured.
        problem = replace(problem.with_simulator(problem.simulator, None), discretization_error={})
        lines = [row("data sheet", absolute_errors(problem, [EMPTY], problem.held_out)[0])]
        notes = []
        if not args.no_diagnosis:
            words, errors, near = diagnosed(args.out, gain, args.seconds)
            lines.append(row("diagnosed", errors))
            means = 1e3 * near[:, :3].mean(axis=1)
            notes.append(f"diagnosed: {words}")
            notes.append(
                f"{NEIGHBOURS} neighbours, every value {NEARBY:.0%} off: mean of the first three "
                f"{np.median(means):.1f} ({means.min():.1f} to {means.max():.1f})"
            )
        if args.structure:
            kept = args.out / f"structure_without_{gain}.json"
            found = given(problem, kept, args.generations, args.seed)
            errors = absolute_errors(problem, [found], problem.held_out)[0]
            lines.append(row("structure given", errors))
            on_fit = absolute_errors(problem, [found], problem.fit)[0]
            lines.append(row("structure given, mean of the fits", on_fit.reshape(-1, 4).mean(0)))
            named = [
                f"{t.effect} {p.reported_name} {p.reported(x * problem.scales.value(p, 0)):.4g}"
                for t in found.terms
                for p, x in zip(t.parameters, found.theta[found.slice_of(t)], strict=True)
            ]
            notes.append("structure given: " + ", ".join(named))
        print(f"\nGain {gain} held out, mean absolute error in mrad:")
        print("| model | " + " | ".join(LOGS) + " | mean of the first three |")
        print("|---" * 6 + "|")
        print("\n".join([*lines, "", *notes]), flush=True)


if __name__ == "__main__":
    main()
