"""Would a fitted calibrator give better confidences than the comparison's own, on other machines?

    TWIN_RECORDINGS=FOLDER python benchmarks/changes/calibrator.py --collect [MACHINE ...]
    python benchmarks/changes/calibrator.py

The first writes one line for each alarm with a first name to ``answers/calibrator.jsonl``: laws are
added to real efforts as in ``machines.py`` and ``baxter.py``, and only derived figures are stored.
The second fits a logistic regression to half of the machines and tests it on the others, in both
directions of each of the three divisions.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import baxter
import machines
import numpy as np
from injected import NEW, in_process
from scipy.optimize import minimize
from scipy.special import expit

STORE = Path(__file__).parent / "answers" / "calibrator.jsonl"
MACHINES = ("emps", "panda", "tiago", "baxter")
SIZES = (0.3, 1.0, 3.0)
FEATURES = ("log_odds", "gap", "log_size", "collinearity", "new")
RIDGE = 1.0
"""Weight of the squared standardized coefficients: 1, a normal prior."""
CLIP = 1e-3
"""Smallest distance of a probability from 0 and 1, for the log loss of both."""


def collect(names: Sequence[str]) -> None:
    """Append the cases of machines that have a first name above the alarm level."""
    for machine in names:
        if machine == "baxter":
            with tempfile.TemporaryDirectory() as scratch:
                robot = baxter.read(baxter.write_recordings(Path(scratch)))
        else:
            robot = machines.read(machine)
        random = np.random.default_rng(1)
        choices = [
            tuple(sorted(random.permutation(robot.count)[:count].tolist())) for count in (NEW, 1)
        ]
        with STORE.open("a") as store:
            for r, outcomes in in_process(robot, choices, 1, SIZES).items():
                for one in outcomes:
                    # At a joint that earlier recordings do not predict, the command has no name.
                    if r and one.score > one.threshold and one.confidence > 0.0:
                        line = {
                            "machine": machine, "r": r, "effect": one.effect, "joint": one.joint,
                            "right": one.is_right, "confidence": round(one.confidence, 6),
                            **{name: round(value, 4) for name, value in one.evidence.items()},
                        }  # fmt: skip
                        print(json.dumps(line), file=store)
        print(machine, "collected", flush=True)


def fitted(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(features + 1,) coefficients of a logistic regression with a ridge."""

    def loss(coefficients: np.ndarray) -> tuple[float, np.ndarray]:
        logit = rows @ coefficients[1:] + coefficients[0]
        gradient = expit(logit) - right
        penalty = 0.5 * RIDGE * float(coefficients[1:] @ coefficients[1:])
        return (
            float(np.sum(np.logaddexp(0.0, logit) - right * logit)) + penalty,
            np.append(gradient.sum(), rows.T @ gradient + RIDGE * coefficients[1:]),
        )

    return np.asarray(minimize(loss, np.zeros(rows.shape[1] + 1), jac=True, method="BFGS").x)


def losses(probability: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log loss and Brier score of each case."""
    p = np.clip(probability, CLIP, 1.0 - CLIP)
    return -np.log(np.where(right, p, 1.0 - p)), (p - right) ** 2


def show(cases: Sequence[dict[str, float]], trained: Sequence[str]) -> None:
    """Print how much lower the losses of the calibrator are on the machines that it never saw."""
    every = np.array([[one[name] for name in FEATURES] for one in cases])
    right = np.array([bool(one["right"]) for one in cases])
    own = np.array([one["confidence"] for one in cases])
    seen = np.array([one["machine"] in trained for one in cases])
    mean, spread = every[seen].mean(axis=0), np.maximum(every[seen].std(axis=0), 1e-6)
    rows = (every - mean) / spread
    coefficients = fitted(rows[seen], right[seen].astype(float))
    calibrated = expit(rows[~seen] @ coefficients[1:] + coefficients[0])
    text = []
    for name, before, after in zip(
        ("log loss", "Brier score"),
        losses(own[~seen], right[~seen]), losses(calibrated, right[~seen]), strict=True,
    ):  # fmt: skip
        lower = before - after
        error = float(lower.std(ddof=1)) / np.sqrt(len(lower))
        text.append(
            f"{name} {before.mean():.3f} own, {after.mean():.3f} calibrated, lower by "
            f"{lower.mean():+.3f} (standard error {error:.3f})"
        )
    print(f"fitted to {'+'.join(trained)} ({int(seen.sum())} cases), {int((~seen).sum())} others: ")
    print("  " + "; ".join(text))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--collect", nargs="*", metavar="MACHINE", help="write the cases")
    args = parser.parse_args()
    if args.collect is not None:
        collect(args.collect or MACHINES)
        return
    cases = [json.loads(line) for line in STORE.read_text().splitlines()]
    for trained in itertools.combinations(MACHINES, len(MACHINES) // 2):
        show(cases, trained)


if __name__ == "__main__":
    main()
