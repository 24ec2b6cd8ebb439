"""One law of the catalogue alone on a drawn joint whose motion excites it at ten times the noise.

The plant is the model with the law, in MuJoCo with a time step of a 64th of the model's, so that
its integration error is below the noise: a robot has none. It shares the laws with the package,
because whether a law is named is the question, not whether it is right. Size of the law and
excitation are judged by the change of the readings alone: a joint and a motion are drawn again
until the law, at a size within its physical bounds, changes the readings by ten times their noise.
Laws that reproduce this change to within the noise, with any parameters, are in the truth file: on
these recordings nothing separates them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frozen.problem import Inputs
from pytest_twin.diagnosis.patched.replay import whole_segment
from pytest_twin.diagnosis.problem import effect_values, joint_scales, replay_nominal
from pytest_twin.effects import catalogue
from pytest_twin.effects.batch_simulator import BatchSimulator
from pytest_twin.effects.proposal import amplitude_indices, starting_sizes
from pytest_twin.effects.segment import Predicted, Segment
from pytest_twin.estimation.hypothesis import EMPTY, Hypothesis, Scales, Term
from pytest_twin.estimation.least_squares import fit
from pytest_twin.formats.mcap import JointSeries, write_recording
from pytest_twin.realization import Realization, load
from pytest_twin.trial import Trial

Floats = NDArray[np.float64]

TIMES_NOISE = 10.0
"""Root mean square change of the readings by the law, in standard deviations of their noise."""
SAME = 1.0
"""The same measure, up to which another law predicts the same."""
FINER = 64
"""Steps of the plant in one step of the model."""
TRIES = 30
"""Joints and motions that are drawn until one excites the law."""
ROLES = ("fit", "fit", "fit", "held_out")
SECONDS = 4.0
COMMAND_PERIOD, STATE_PERIOD = 0.004, 0.005
SIZES = np.geomspace(1e-3, 10.0, 13)
"""Multiples of a starting size of the law that are tried."""
HALVINGS = 6
"""Steps of the search for the size between two of these multiples."""
STARTS = 6
"""Starting sizes of each other law that are tried."""
NEAR = 0.95
"""Share of the change that a scaled law may leave to be fitted."""
ITERATIONS = 10
"""Iterations of this fit."""


def laws() -> list[str]:
    """Return all laws that can act on one joint, or between two."""
    return sorted(
        name
        for name, law in catalogue().items()
        if law.candidate and law.family != "contact" and not name.startswith("unnamed_")
    )


@dataclass(frozen=True)
class Drawn:
    """A joint, its motion, and the noise of its readings.

    Attributes:
        mjcf: the model.
        joints: names; the law acts on the last.
        mode: what is commanded.
        slides: whether the joints are prismatic.
        commands: (recordings, samples, joints) commands, every :data:`COMMAND_PERIOD`.
        noise: standard deviation of the positions, rad or m.
        velocity, effort: whether the log has them.
    """

    mjcf: str
    joints: tuple[str, ...]
    mode: str
    slides: bool
    commands: Floats
    noise: float
    velocity: bool
    effort: bool


def make(seed: int, folder: Path) -> Inputs:
    """Write model, recordings and truth of one seed.

    Raises:
        RuntimeError: no drawn joint and motion excites the law within its physical bounds.
    """
    names = laws()
    effect = names[seed % len(names)]
    rng = np.random.default_rng([20_261_130, seed])
    folder.mkdir(parents=True, exist_ok=True)
    for _ in range(TRIES):
        drawn = draw(effect, rng)
        (folder / "model.xml").write_text(drawn.mjcf)
        coarse = Plant(drawn, load(folder / "model.xml"), 1)
        theta = coarse.size_of(effect, rng)
        if theta is not None:
            break
    else:
        raise RuntimeError(f"{effect}: no drawn motion changes the readings enough")
    plant = Plant(drawn, coarse.realization, FINER)
    hidden = plant.only(effect, theta)
    nominal, real = plant.readings([EMPTY, hidden])
    truth = {
        "case": f"one_law{seed:02d}", "family": "one_law", "kind": "one", "mode": drawn.mode,
        "joints": list(drawn.joints), "contact": False, "outside": None, "background": [],
        "effects": [
            {
                "effect": effect, "joint": plant.joint_of(effect),
                "parameters": plant.values(effect, theta),
                "visibility": round(plant.change(nominal, real, effect), 2),
                "equivalents": coarse.equivalents(hidden),
            }
        ],
    }  # fmt: skip
    fit, held_out = plant.write(folder, real, rng)
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")
    return Inputs(folder / "model.xml", fit, held_out, truth)


def draw(effect: str, rng: np.random.Generator) -> Drawn:
    """Draw a joint on which the law can act, and its motion."""
    law = catalogue()[effect]
    weights = {"position": 0.7, "velocity": 0.15, "effort": 0.15}
    modes = [m for m in weights if m in law.modes]
    share = np.array([weights[m] for m in modes])
    mode = str(rng.choice(modes, p=share / share.sum()))
    joints = ("shoulder", "joint") if effect == "joint_coupling" else ("joint",)
    slides = bool(rng.random() < 0.25) and not law.periodic and mode != "effort"
    mjcf = _mjcf(joints, mode, slides, rng)
    time = np.arange(0.0, SECONDS, COMMAND_PERIOD)
    commands = np.stack(
        [np.stack([_motion(k, mode, time, rng) for _ in joints], axis=1) for k in range(len(ROLES))]
    )
    if mode == "effort":
        commands *= float(rng.uniform(2.0, 5.0))
    return Drawn(
        mjcf, joints, mode, slides, commands, float(rng.choice([3e-5, 1e-4, 3e-4])),
        bool(rng.random() < 0.5), bool(rng.random() < 0.4) or law.needs_effort_sensor,
    )  # fmt: skip


def _mjcf(joints: Sequence[str], mode: str, slides: bool, rng: np.random.Generator) -> str:
    kind = "slide" if slides else "hinge"
    bodies, ends, actuators = [], [], []
    for k, name in enumerate(joints):
        mass, length = rng.uniform(0.5, 3.0), rng.uniform(0.1, 0.35)
        armature = rng.uniform(0.01, 0.05) if not slides else rng.uniform(0.2, 1.0)
        inertia = mass if slides else 1.4 * mass * length**2
        total = inertia + armature
        frequency = rng.uniform(15.0, 45.0)
        kp, kv = total * frequency**2, 2.0 * rng.uniform(0.5, 0.9) * total * frequency
        damping = rng.uniform(0.02, 0.1) * kv
        axis = "1 0 0" if slides else "0 1 0"
        at = "" if not k else f' pos="0 0 {-0.3 if not slides else 0}"'
        across, along = 0.4 * mass * length**2, 0.1 * mass * length**2
        bodies.append(
            f'<body name="link_{name}"{at}>'
            f'<inertial pos="0 0 {-length:.5f}" mass="{mass:.5f}" diaginertia='
            f'"{across:.6f} {across:.6f} {along:.6f}"/>'
            f'<joint name="{name}" type="{kind}" axis="{axis}" armature="{armature:.5f}" '
            f'damping="{damping:.5f}" frictionloss="{rng.uniform(0.005, 0.02) * kv:.5f}"/>'
        )
        ends.append("</body>")
        actuators.append(
            {
                "position": f'<position joint="{name}" kp="{kp:.4f}" kv="{kv:.4f}"/>',
                "velocity": f'<velocity joint="{name}" kv="{4.0 * kv:.4f}"/>',
                "effort": f'<motor joint="{name}"/>',
            }[mode]
        )
    return (
        '<mujoco model="drawn"><compiler angle="radian"/>'
        '<option timestep="0.001" integrator="implicitfast"/><worldbody>'
        f"{''.join(bodies)}{''.join(ends)}</worldbody><actuator>{''.join(actuators)}</actuator>"
        "</mujoco>\n"
    )


def _roughness(values: Floats) -> Floats:
    """(n, joints) largest absolute second difference at a sample and beside it."""
    second = np.abs(np.diff(np.pad(values, ((2, 2), (0, 0)), mode="edge"), n=2, axis=0))
    return np.asarray(np.max([second[:-2], second[1:-1], second[2:]], axis=0))


def _motion(kind: int, mode: str, time: Floats, rng: np.random.Generator) -> Floats:
    """(n,) commands of a recording: two kinds of multisine, moves with rests, slow reversals."""
    if kind == 1:
        starts = np.arange(0.3, SECONDS, 0.7)
        levels = np.concatenate([[0.0], rng.uniform(-0.7, 0.7, len(starts))])
        speed = rng.uniform(1.0, 4.0)
        times, values = [0.0], [0.0]
        for start, before, after in zip(starts, levels[:-1], levels[1:], strict=True):
            times += [start, start + max(abs(after - before) / speed, 0.02)]
            values += [before, after]
        path = np.interp(time, times, values)
    else:
        rates = rng.uniform(0.15, 0.5, 2) if kind == 2 else np.array([0.4, 1.0, 2.1, 3.7])
        phases = rng.uniform(0.0, 2.0 * np.pi, len(rates))
        size = 0.5 / len(rates) * rng.uniform(0.6, 1.6, len(rates))
        waves = size[:, None] * np.sin(2.0 * np.pi * rates[:, None] * time + phases[:, None])
        path = waves.sum(axis=0) * np.minimum(time / 0.4, 1.0)
    return np.gradient(path, time) if mode == "velocity" else path


class Plant:
    """The drawn joint in simulation, with any law at any size."""

    def __init__(self, drawn: Drawn, realization: Realization, finer: int) -> None:
        self.drawn, self.realization = drawn, realization
        segments = [self._segment(k) for k in range(len(ROLES))]
        at_rest = BatchSimulator(segments, drawn.joints, threads=1, refine=finer)
        moved = [
            replace(s, position=p.position)
            for s, p in zip(segments, replay_nominal(at_rest), strict=True)
        ]
        self.simulator = BatchSimulator(moved, drawn.joints, threads=1, refine=finer)
        self.nominal = replay_nominal(self.simulator)
        self.scales: Scales = joint_scales(self.simulator, self.nominal)
        efforts = np.concatenate([p.effort for p in self.nominal])
        self.effort_noise = 0.005 * max(float(np.sqrt(np.mean(efforts**2))), 1e-3)
        # A reading beside a jump of the effort is uncertain by the jump.
        self.effort_levels = [
            np.hypot(self.effort_noise, _roughness(p.effort)) for p in self.nominal
        ]

    def _segment(self, k: int) -> Segment:
        drawn = self.drawn
        time = np.arange(0.0, SECONDS - 2.0 * COMMAND_PERIOD, STATE_PERIOD)
        rest = np.zeros((len(time), len(drawn.joints)))
        sent = COMMAND_PERIOD * np.arange(drawn.commands.shape[1])
        trial = Trial(
            Path(f"{k}.mcap"), 0, drawn.joints, time, rest, np.zeros_like(rest), None,
            drawn.joints, sent, drawn.commands[k],
            (drawn.mode,) * len(drawn.joints), {},
        )  # fmt: skip
        return whole_segment(self.realization, trial, drawn.joints, 1.0)

    def readings(self, hypotheses: Sequence[Hypothesis]) -> list[list[Predicted]]:
        """Return sensor readings of all recordings, for each hypothesis."""
        count = len(ROLES)
        rows = np.tile(np.arange(count), len(hypotheses))
        each = [h for h in hypotheses for _ in range(count)]
        with np.errstate(all="ignore"):
            values = effect_values(each, len(self.drawn.joints), self.scales)
            flat = self.simulator.simulate(rows, values)
        return [flat[i : i + count] for i in range(0, len(flat), count)]

    def term(self, effect: str) -> Term:
        """Return the effect at the last joint, or of the robot."""
        robot = catalogue()[effect].scope == "robot"
        return Term(effect, -1 if robot else len(self.drawn.joints) - 1)

    def joint_of(self, effect: str) -> str | None:
        """Return the joint of an effect; None for one of the robot."""
        return None if self.term(effect).joint < 0 else self.drawn.joints[-1]

    def only(self, effect: str, theta: Floats) -> Hypothesis:
        """Return the hypothesis with this effect alone."""
        return EMPTY.with_term(self.term(effect), theta)

    def values(self, effect: str, theta: Floats) -> dict[str, float]:
        """Return reported parameters of an effect, SI units."""
        term = self.term(effect)
        return {
            p.name if p.reciprocal_of is None else p.reciprocal_of[0]: float(
                p.reported(float(x) * self.scales.value(p, term.joint))
            )
            for p, x in zip(term.parameters, theta, strict=True)
            if not p.choice and x
        }

    def change(self, one: list[Predicted], other: list[Predicted], effect: str) -> float:
        """Return the root mean square difference of two readings, in their noise."""
        of_effort = catalogue()[effect].needs_effort_sensor
        noise = self.effort_noise if of_effort else self.drawn.noise
        squared = []
        for a, b in zip(one, other, strict=True):
            off = a.effort - b.effort if of_effort else a.position - b.position
            squared.append(np.mean(off**2))
        level = float(np.sqrt(np.mean(squared))) / noise
        return level if np.isfinite(level) else np.inf

    def size_of(self, effect: str, rng: np.random.Generator) -> Floats | None:
        """Return parameters that change the readings by ten times the noise; None if none do."""
        starts = starting_sizes(catalogue()[effect])
        for k in rng.permutation(len(starts))[:3]:
            start = starts[int(k)]
            sized = [self._sized(effect, start, s) for s in SIZES]
            levels = np.array(
                [
                    self.change(self.nominal, r, effect)
                    for r in self.readings([self.only(effect, theta) for theta in sized])
                ]
            )
            above = np.flatnonzero((levels >= TIMES_NOISE) & np.isfinite(levels))
            if not len(above) or not above[0] or not np.isfinite(levels[above[0]]):
                continue
            low, high = float(SIZES[above[0] - 1]), float(SIZES[above[0]])
            for _ in range(HALVINGS):
                middle = float(np.sqrt(low * high))
                (reading,) = self.readings([self.only(effect, self._sized(effect, start, middle))])
                if self.change(self.nominal, reading, effect) < TIMES_NOISE:
                    low = middle
                else:
                    high = middle
            return self._sized(effect, start, high)
        return None

    @staticmethod
    def _sized(effect: str, start: Floats, factor: float) -> Floats:
        """Return a start with its amplitudes multiplied, within their physical bounds."""
        law = catalogue()[effect]
        theta = start.copy()
        for k in amplitude_indices(law, start):
            p = law.parameters[k]
            theta[k] = np.clip(factor * start[k], p.lower, p.upper)
        return theta

    def equivalents(self, hidden: Hypothesis) -> list[list[Any]]:
        """Return [effect, joint] of laws that predict the same readings to within the noise.

        A law is fitted from all its starting sizes if one of them, scaled, explains a part.
        """
        (term,) = hidden.terms
        starts: list[tuple[str, Floats]] = []
        for name in laws():
            law = catalogue()[name]
            usable = self.drawn.mode in law.modes or law.family not in ("actuation", "timing")
            periodic = law.periodic and self.drawn.slides
            coupled = name == "joint_coupling" and len(self.drawn.joints) == 1
            unseen = law.needs_effort_sensor and not self.drawn.effort
            if name != term.effect and usable and not (periodic or coupled or unseen):
                starts += [(name, s) for s in starting_sizes(law)[:STARTS]]
        real, *found = self.readings([hidden, *(self.only(name, s) for name, s in starts)])
        nominal = self.stacked(self.nominal)
        wanted = self.stacked(real) - nominal
        explains = set[str]()
        for (name, _), reading in zip(starts, found, strict=True):
            change = self.stacked(reading) - nominal
            if np.isfinite(change).all() and change.any():
                factor = float(change @ wanted / (change @ change))
                left = float(np.linalg.norm(factor * change - wanted))
                if left <= NEAR * float(np.linalg.norm(wanted)):
                    explains.add(name)
        starts = [(name, start) for name, start in starts if name in explains]
        fits = fit(
            _Change(self, self.stacked(real)), [self.only(name, start) for name, start in starts],
            np.ones(1), np.arange(len(ROLES)), iterations=ITERATIONS, slopes=False,
        )  # fmt: skip
        closest: dict[str, float] = {}
        for (name, _), found_fit in zip(starts, fits, strict=True):
            closest[name] = min(closest.get(name, np.inf), float(np.sqrt(found_fit.cost)))
        general = {
            name for name in laws()
            if term.effect in catalogue()[name].generalizes or name in term.law.generalizes
        }  # fmt: skip
        same = {name for name, off in closest.items() if off <= SAME} | (general & set(closest))
        return [[name, self.joint_of(name)] for name in sorted(same)]

    def stacked(self, readings: list[Predicted]) -> Floats:
        """Return all readings in multiples of their noise."""
        parts = [p.position.ravel() / self.drawn.noise for p in readings]
        if self.drawn.effort:
            parts += [
                (p.effort / level).ravel()
                for p, level in zip(readings, self.effort_levels, strict=True)
            ]
        return np.concatenate(parts)

    def write(
        self, folder: Path, real: list[Predicted], rng: np.random.Generator
    ) -> tuple[list[Path], list[Path]]:
        """Write the recordings with noise; return those to fit and those held out."""
        drawn, files = self.drawn, list[tuple[str, Path]]()
        for k, (role, reading) in enumerate(zip(ROLES, real, strict=True)):
            time = self.simulator.segments[k].time
            stamp = np.round(1e9 * time).astype(np.int64) + 1_700_000_000_000_000_000

            def noisy(values: Floats, level: float) -> Floats:
                return np.asarray(values + level * rng.standard_normal(values.shape))

            states = JointSeries(
                "/joint_states", drawn.joints, stamp, stamp,
                noisy(reading.position, drawn.noise),
                noisy(reading.velocity, 0.005) if drawn.velocity else None,
                noisy(reading.effort, self.effort_noise) if drawn.effort else None,
            )  # fmt: skip
            sent = np.round(1e9 * COMMAND_PERIOD * np.arange(drawn.commands.shape[1]))
            sent_stamp = sent.astype(np.int64) + 1_700_000_000_000_000_000
            fields: dict[str, Floats | None] = dict.fromkeys(("position", "velocity", "effort"))
            fields[drawn.mode] = drawn.commands[k]
            commands = JointSeries(
                "/joint_commands", drawn.joints, sent_stamp, sent_stamp,
                fields["position"], fields["velocity"], fields["effort"],
            )  # fmt: skip
            metadata: Mapping[str, str] = {
                "role": role, "command_between": "held", "source": "robot",
            }  # fmt: skip
            path = folder / f"{k}_{role}.mcap"
            write_recording(path, [states, commands], metadata)
            files.append((role, path))
        return (
            [p for role, p in files if role == "fit"],
            [p for role, p in files if role == "held_out"],
        )


@dataclass(frozen=True)
class _Change:
    """Differences of predicted readings to those of the plant, for a fit.

    Attributes:
        wanted: stacked readings of the plant.
    """

    plant: Plant
    wanted: Floats

    def residuals(
        self, hypotheses: Sequence[Hypothesis], segments: NDArray[np.int64]
    ) -> list[Floats]:
        """(samples, 1) differences in noise levels, for each hypothesis."""
        found = self.plant.readings(hypotheses)
        return [(self.wanted - self.plant.stacked(each))[:, None] for each in found]
