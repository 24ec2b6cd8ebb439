"""Two sessions of arms with measured effort, between which one thing changed, through the command.

    python benchmarks/changes/effort_pairs.py [--robots ur5,panda] [--seeds 0,1] [--earlier N]
    python benchmarks/changes/effort_pairs.py --robots ur5,ur10,panda,z1 --unchanged 10

Rigid-body dynamics by Pinocchio, with masses that the model lacks and a background that it does not
describe: Stribeck and load-dependent friction, a ripple, offsets, friction that differs between
recordings. Efforts are filtered and noisy, stamps jitter, every motion is another one, and there is
one new recording. With ``--unchanged N``: N other arms of each robot, on which nothing changed.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from baxter import urdf
from injected import LEVEL, interval
from scipy import signal

from pytest_twin import cli
from pytest_twin.changes.find_changes import find_changes
from pytest_twin.changes.recordings import read_compared
from pytest_twin.loaded_model import load_model
from pytest_twin.recording_options import RecordingOptions

ROBOTS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur10": "ur_description/urdf/ur10_robot.urdf",
    "panda": "panda_description/urdf/panda.urdf",
    "z1": "z1_description/urdf/z1.urdf",
}
RATE, SECONDS = 100.0, 20.0
RIGHT = {
    "payload": {"payload"},
    "friction": {"coulomb_friction", "viscous_friction"},
    "torque_constant": {"effort_scale"},
    "joint_offset": {"encoder_bias"},
    "wear": {"coulomb_friction", "load_dependent_friction"},
    "warmer": {"viscous_friction"},
}
"""Simulated change -> effects that count as its right name."""


@dataclass(frozen=True)
class Change:
    """What changed: a payload, factors of one joint, a factor of all viscous friction."""

    joint: int = 0
    mass: float = 0.0
    place: tuple[float, ...] = (0.0, 0.0, 0.0)
    coulomb: float = 1.0
    viscous: float = 1.0
    load: float = 0.0
    scale: float = 1.0
    offset: float = 0.0
    warmth: float = 1.0


@dataclass
class Arm:
    """A true arm; sizes of its background are relative to the typical effort of each joint."""

    path: Path
    random: np.random.Generator
    model: pin.Model = field(init=False)

    def __post_init__(self) -> None:
        model, random = pin.buildModelFromUrdf(str(self.path)), self.random
        fixed = [i + 1 for i, name in enumerate(model.names[1:]) if "finger" in name.lower()]
        if fixed:
            model = pin.buildReducedModel(model, fixed, pin.neutral(model))
        for i in range(1, model.njoints):
            body, factor = model.inertias[i], random.uniform(0.85, 1.2)
            model.inertias[i] = pin.Inertia(
                body.mass * factor, body.lever + 0.005 * random.normal(size=3),
                np.asarray(body.inertia) * factor * random.uniform(0.8, 1.3),
            )  # fmt: skip
        self.model, self.joints = model, list(model.names[1:])
        count, data = model.nv, model.createData()
        some = random.uniform(-1.0, 1.0, (200, count))
        tried = np.array(
            [pin.rnea(model, data, q, 0.0 * q, random.normal(size=count)) for q in some]
        )
        self.size = np.maximum(tried.std(axis=0), 0.05 * tried.std(axis=0).max())
        self.coulomb, self.viscous = self.size * random.uniform(0.05, 0.3, (2, count))
        self.stiction = self.coulomb * random.uniform(0.0, 0.6, count)
        self.armature = 0.1 * self.size * random.uniform(0.2, 1.0, count)
        self.ripple = self.size * random.uniform(0.0, 0.03, count)
        self.waves = random.integers(5, 40, count)
        self.load = random.uniform(0.0, 0.06, count)
        self.offset = self.size * random.uniform(-0.05, 0.05, count)
        self.middle = random.uniform(-0.6, 0.6, count)

    def record(self, path: Path, change: Change) -> Path:
        """Write a recording along a random motion."""
        random, count, model = self.random, self.model.nv, self.model.copy()
        if change.mass:
            last = model.njoints - 1
            load = pin.Inertia(change.mass, np.array(change.place), 9e-4 * change.mass * np.eye(3))
            model.inertias[last] = model.inertias[last] + load
        fine = np.arange(int(4 * SECONDS * RATE) + 40) / (4 * RATE)
        omega = 2.0 * np.pi * 0.12 * np.arange(1, 6)
        sine, cosine = random.uniform(-0.35, 0.35, (2, 5, count)) / np.arange(1, 6)[:, None] ** 0.5
        s, c = np.sin(np.outer(fine, omega)), np.cos(np.outer(fine, omega))
        q = self.middle + random.uniform(-0.2, 0.2, count) + s @ sine + c @ cosine
        v = (c * omega) @ sine - (s * omega) @ cosine
        a = -(s * omega**2) @ sine - (c * omega**2) @ cosine
        data = model.createData()
        effort = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
        weight = np.array([pin.computeGeneralizedGravity(model, data, row) for row in q])
        coulomb = self.coulomb * (1.0 + 0.03 * random.normal(size=count))
        viscous = self.viscous * change.warmth * (1.0 + 0.04 * random.normal(size=count))
        load, own = self.load.copy(), change.joint
        coulomb[own] *= change.coulomb
        viscous[own] *= change.viscous
        load[own] += change.load
        level = coulomb + self.stiction * np.exp(-((v / 0.1) ** 2)) + load * np.abs(weight)
        effort += self.armature * a + viscous * v + level * np.tanh(v / 0.01) + self.offset
        effort += self.ripple * np.sin(self.waves * q)
        effort[:, own] *= change.scale
        effort += 0.02 * self.size * random.normal(size=effort.shape)
        low = signal.butter(2, 12.0, fs=4 * RATE, output="sos")
        effort = signal.sosfiltfilt(low, effort, axis=0)
        stamps = np.arange(round(SECONDS * RATE)) / RATE
        stamps = np.sort(stamps + random.uniform(-0.025, 0.025, len(stamps)) / RATE)
        stamps -= stamps[0]
        seen, read = (
            np.stack([np.interp(stamps, fine, column) for column in values.T], axis=1)
            for values in (q, effort)
        )
        seen[:, own] += change.offset
        seen += 2e-5 * random.normal(size=seen.shape)
        head = ["time", *(f"{j}.position" for j in self.joints)]
        head += [f"{j}.effort" for j in self.joints]
        table = np.column_stack([stamps, seen, read])
        np.savetxt(path, table, fmt="%.8g", delimiter=",", header=",".join(head), comments="")
        return path


def changes(arm: Arm) -> dict[str, Change]:
    """Name -> what changed."""
    random, joint = arm.random, int(arm.random.integers(arm.model.nv))
    mass = sum(body.mass for body in arm.model.inertias) * random.uniform(0.03, 0.12)
    place = tuple(random.uniform(-0.04, 0.08, 3).tolist())
    return {
        "nothing": Change(),
        "payload": Change(mass=mass, place=place),
        "friction": Change(joint, coulomb=1.3, viscous=1.3),
        "torque_constant": Change(joint, scale=1.0 / 0.92),
        "joint_offset": Change(joint, offset=0.03),
        "wear": Change(joint, coulomb=1.4, load=0.04),
        "warmer": Change(warmth=0.75),
    }


def diagnosed(model: Path, new: Path, earlier: list[Path], out: Path) -> Mapping[str, Any]:
    """``diagnosis.json`` of the comparison."""
    silent = io.StringIO()
    with contextlib.redirect_stdout(silent), contextlib.redirect_stderr(silent):
        status = cli.main([
            "diagnose", str(model), str(new), "--before", *map(str, earlier), "--out", str(out),
        ])  # fmt: skip
    if status == 2:
        raise SystemExit(silent.getvalue())
    document: Mapping[str, Any] = json.loads((out / "diagnosis.json").read_text())
    return document


def words(document: Mapping[str, Any]) -> str:
    """Names with their confidence."""
    return (
        ", ".join(f"{f['effect']}@{f['joint']} {f['confidence']:.2f}" for f in document["findings"])
        or document["verdict"]
    )


def alarms_unchanged(robot: str, draws: int, earlier: int) -> int:
    """Alarms among arms on which nothing changed, each with other recordings."""
    alarms = 0
    for seed in range(draws):
        with tempfile.TemporaryDirectory() as scratch:
            arm = Arm(urdf().parents[2] / ROBOTS[robot], np.random.default_rng([1, seed]))
            paths = [arm.record(Path(scratch) / f"{k}.csv", Change()) for k in range(earlier + 1)]
            loaded = load_model(arm.path)
            options = RecordingOptions().over(loaded.options)
            compared = read_compared(
                loaded.realization, paths[:-1], paths[-1:], [], loaded.topics, options
            )
            comparison = find_changes(loaded.realization, compared, LEVEL).comparison
        alarms += comparison.is_changed
        names = [
            f"{change.shape.term.effect}@{arm.joints[change.shape.term.joint]} "
            f"{change.confidence:.2f}"
            for change in comparison.changes
        ]
        print(
            f"{robot} {seed}: score {comparison.score:.2f}, level {comparison.threshold:.2f}; "
            f"scores before {np.round(comparison.null.scores, 1).tolist()}; "
            f"unlike {np.flatnonzero(comparison.unlike).tolist()}; "
            f"uncertainty {comparison.uncertainty.max():.2f} "
            f"{'alarm' if comparison.is_changed else 'no alarm'} {names}",
            flush=True,
        )
    return alarms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", default="ur5,panda", help="of " + ", ".join(ROBOTS))
    parser.add_argument("--seeds", default="0,1")
    parser.add_argument("--earlier", type=int, default=5, help="earlier recordings")
    parser.add_argument("--unchanged", type=int, metavar="N", help="N unchanged arms of each")
    args = parser.parse_args()
    if args.unchanged:
        robots = args.robots.split(",")
        alarms = [alarms_unchanged(robot, args.unchanged, args.earlier) for robot in robots]
        tests = args.unchanged * len(robots)
        print(f"{sum(alarms)} alarms of {tests} ({interval(sum(alarms), tests)}): {alarms}")
        return
    counts: dict[str, list[int]] = {}
    masses = inside = 0
    for robot in args.robots.split(","):
        for seed in map(int, args.seeds.split(",")):
            with tempfile.TemporaryDirectory() as scratch:
                folder = Path(scratch)
                arm = Arm(urdf().parents[2] / ROBOTS[robot], np.random.default_rng(seed))
                earlier = [
                    arm.record(folder / f"old{k}.csv", Change()) for k in range(args.earlier)
                ]
                for name, change in changes(arm).items():
                    new = arm.record(folder / f"{name}.csv", change)
                    document = diagnosed(arm.path, new, earlier, folder / "out")
                    found = document["findings"]
                    right = [f for f in found if f["effect"] in RIGHT.get(name, set())
                             and f["joint"] in (None, arm.joints[change.joint], *(
                                 arm.joints if name == "warmer" else ()))]  # fmt: skip
                    wrong = [f for f in found if f not in right and f["confidence"] >= 0.9]
                    first = bool(found) and found[0] in right
                    tally = counts.setdefault(name, [0, 0, 0, 0])
                    tally[0] += 1
                    tally[1] += document["verdict"] != "no_change"
                    tally[2] += first
                    tally[3] += len(wrong)
                    text = words(document)
                    if name == "payload" and first:
                        low, high = found[0]["change"]["mass"]["ci95"]
                        masses, inside = masses + 1, inside + (low < change.mass < high)
                        text += f", {low:.2f} to {high:.2f} kg, true {change.mass:.2f}"
                    where = arm.joints[change.joint] if change.joint else ""
                    print(f"{robot} {seed} {name} {where}: {text}", flush=True)
    for name, (cases, alarms, first, wrong) in counts.items():
        print(f"{name}: {cases} cases, {alarms} alarms, {first} right first, {wrong} wrong at 0.9")
    print(f"masses in their interval: {inside} of {masses}")


if __name__ == "__main__":
    main()
