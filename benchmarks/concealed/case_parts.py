"""Common parts of the case families: size of effects against the background, and case files.

A family has a plant; a :class:`Scene` is a robot in it. The hidden effects exceed the background by
a random factor of 3 to 30: the ratio of RMS changes of held-out positions by the hidden effects and
by all other deviations from the nominal model.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from cases import EFFORT_EFFECTS, SAME, sizes, stretches
from cell import Background, Cell
from equivalents import equivalents
from logger import Logger, Traces, read_at, write
from plant import Hidden
from robots import Robot, mjcf
from setpoints import FINE

ROLES = ("fit", "fit", "fit", "held_out", "held_out")
HELD_OUT = slice(ROLES.index("held_out"), None)
STANDS_OUT = (3.0, 30.0)
"""Range of the random factor."""
FARTHEST = 20.0
"""Position error above which a robot does not follow its commands, rad or m."""
INVERSE = {"rate_limit": ("rate",), "torque_saturation": ("limit",),
           "torque_speed_limit": ("stall", "no_load_speed")}  # fmt: skip
FIXED = ("harmonic", "in_loop", "stribeck_velocity", "presliding_distance", "warm_up_time", "start",
         "duration", "no_load_speed", "damping_time")  # fmt: skip

LEAST = {"contact_friction": -0.28}
"""Largest relative error of an effect, so that stiffness, gain or friction stays positive."""


class Run(Protocol):
    """Simulated motion of a robot; arrays are (samples, recordings, joints)."""

    @property
    def period(self) -> float:
        """Time between samples, s."""

    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    demand: np.ndarray


def hide(
    named: tuple[str, ...], places: Callable[[str, Robot], list[int]], count: int, robot: Robot,
    rng: np.random.Generator,
) -> Hidden:  # fmt: skip
    """Choose ``count`` effects of ``named``, none with the same physics at one joint."""
    hidden = Hidden()
    left = [str(e) for e in rng.permutation(named)]
    while sum(len(at) for at in hidden.effects.values()) < count:
        effect = left.pop(0)
        taken = {
            i for other, at in hidden.effects.items() for i in at
            if any({effect, other} <= same for same in SAME)
        }  # fmt: skip
        free = [i for i in places(effect, robot) if i not in taken]
        if free:
            joint = int(rng.choice(free))
            found = sizes(effect, robot, joint, rng)
            if effect == "encoder_bias" and len(robot.joints) == 1:
                found["in_loop"] = True
            hidden.effects[effect] = {joint: found}
    return hidden


def resized(hidden: Hidden, by: float) -> Hidden:
    """Return the same effects, scaled by a factor."""

    def one(effect: str, name: str, value: Any) -> Any:
        if name in INVERSE.get(effect, ()):
            return value / by
        if name.endswith("_error") or effect == "contact_friction":
            return max(value * by, LEAST.get(effect, -0.9))
        return value if name in FIXED or isinstance(value, bool) else value * by

    return Hidden(
        {e: {i: {k: one(e, k, v) for k, v in p.items()} for i, p in at.items()}
         for e, at in hidden.effects.items()}
    )  # fmt: skip


def changes(a: tuple[Run, Hidden], b: tuple[Run, Hidden], which: str = "position") -> np.ndarray:
    """(joints,) RMS difference of held-out positions of two runs at exact stamps, rad or m."""

    def logged(run: Run, hidden: Hidden) -> np.ndarray:
        trace = getattr(run, which)
        at = read_at(np.arange(0.0, len(trace) * run.period - 0.01, 5e-3), hidden) / run.period
        x = np.clip(at, 0.0, len(trace) - 1.001)
        k = x.astype(int)
        part = (x - k)[:, None, None]
        out: np.ndarray = trace[k] * (1 - part) + trace[k + 1] * part
        return out

    difference = logged(*a) - logged(*b)
    out: np.ndarray = np.sqrt(np.mean(difference**2, axis=(0, 1)))
    return out


class Scene(Protocol):
    """A robot with its cell and motions, simulated with selected effects."""

    robot: Robot
    logger: Logger

    def held_out(
        self, hidden: Hidden, background: Background, force: np.ndarray | None, again: Any,
        *, nominal: bool = False,
    ) -> Run:  # fmt: skip
        """Simulate the held-out recordings; if ``nominal``, with nominal servos and friction."""


def shown(
    scene: Scene, hidden: Hidden, background: Background, force: np.ndarray | None
) -> tuple[float, float]:
    """RMS change of positions by hidden effects and by the background, rad.

    It is the root sum of squares over joints. For effects that are visible only in efforts, it is a
    fraction of the peak efforts.
    """
    real = background.without(hidden.effects)
    whole = scene.held_out(hidden, real, force, None)
    # An arm under effort commands diverges after any change, so it is restarted from its true
    # states.
    again = whole if scene.robot.mode == "effort" else None
    without = scene.held_out(Hidden(), background, None, again)
    ideal = scene.held_out(Hidden(), Background(), None, again, nominal=True)
    which = (
        "effort" if hidden.effects and set(hidden.effects) <= set(EFFORT_EFFECTS) else "position"
    )
    each = (changes((whole, hidden), (without, Hidden()), which),
            changes((without, Hidden()), (ideal, Hidden()), which))  # fmt: skip
    if which == "effort":
        peak = np.array([j.effort for j in scene.robot.joints])
        each = each[0] / peak, each[1] / peak
    return float(np.linalg.norm(each[0])), float(np.linalg.norm(each[1]))


def made_to_stand_out(
    scene: Scene, hidden: Hidden, background: Background, force: np.ndarray | None, wanted: float
) -> tuple[Hidden, Background, np.ndarray | None, dict[str, float]]:
    """Scale hidden effects and background to the ratio ``wanted`` of their changes of the motion.

    Both are scaled within plausible limits; the resulting ratio is measured.
    """
    change, rest = shown(scene, hidden, background, force)
    ratio = max(change / rest, 1e-9)
    by = float(np.clip(wanted / ratio, 0.2, 2.0))
    hidden = resized(hidden, by)
    if force is not None:
        force = force.copy()
        force["size"] *= by
    background = background.scaled(float(np.clip(ratio * by / wanted, 0.3, 1.0)))
    change, rest = shown(scene, hidden, background, force)
    return hidden, background, force, {
        "wanted": wanted, "factor": change / rest, "hidden_rms": change, "background_rms": rest,
    }  # fmt: skip


def seen(
    scene: Scene, hidden: Hidden, background: Background, force: np.ndarray | None
) -> dict[tuple[str, int], float]:
    """Change of held-out readings by each effect, in standard deviations of their noise."""
    logger = scene.logger
    noise = float(np.hypot(logger.noise, logger.count / np.sqrt(12.0)))
    real = background.without(hidden.effects)
    whole = scene.held_out(hidden, real, force, None)
    again = whole if scene.robot.mode == "effort" else None
    found = {}
    for effect, at in hidden.effects.items():
        for joint in at:
            less = hidden.without(effect, joint)
            other = scene.held_out(less, real, force, again)
            if effect in EFFORT_EFFECTS:
                level = 2e-3 * np.array([j.effort for j in scene.robot.joints])
                change = changes((whole, hidden), (other, less), "effort") / level
            else:
                change = changes((whole, hidden), (other, less)) / noise
            found[effect, joint] = float(np.max(change))
    return found


def write_case(
    folder: Path, robot: Robot, cell: Cell, logger: Logger, hidden: Hidden, whole: Run,
    sent: np.ndarray, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Write the nominal model and five recordings; ``sent`` has the commands, one row per ms.

    Raises:
        ValueError: the robot diverged, so the case is invalid.
    """
    farthest = float(np.abs(whole.position).max())
    if not farthest < FARTHEST:
        raise ValueError(
            f"{folder.name}: a joint went to {farthest:g}, beyond {FARTHEST:g} rad or m"
        )
    recordings = folder / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    (folder / "model.xml").write_text(mjcf(robot))
    every = round(cell.command_period / FINE)
    holed = int(rng.integers(len(ROLES)))
    for i, (file, role) in enumerate(zip(files(), ROLES, strict=True)):
        traces = Traces(
            whole.period, whole.position[:, i], whole.velocity[:, i], whole.effort[:, i],
            whole.demand[:, i], cell.command_period, sent[::every, i],
        )  # fmt: skip
        trial = {"role": role}
        if cell.declared:
            trial["command_between"] = cell.between
        write(recordings / file, robot, traces, hidden, logger, trial, i == holed, rng)


def files() -> list[str]:
    """Names of the recordings."""
    return [f"{i}.mcap" for i in range(len(ROLES))]


def write_truth(
    path: Path, head: dict[str, Any], robot: Robot, cell: Cell, logger: Logger, hidden: Hidden,
    background: Background, visibility: dict[tuple[str, int], float], tail: dict[str, Any],
    laws: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Write the truth file: hidden effects, background differences, and logging.

    ``laws`` are effects of the whole robot for which reality has another law than the model.
    """
    label = [j.name for j in robot.joints]

    def at(joint: int) -> str | None:
        return None if joint < 0 else label[joint]

    record = {
        **head, "mode": robot.mode, "joints": label, "contact": robot.contact is not None,
        "effects": [
            {"effect": e, "joint": at(i), "parameters": p, "visibility": visibility[e, i],
             "equivalents": [[o, at(k)] for o, k in equivalents(e, i, hidden, robot)]}
            for e, joined in hidden.effects.items() for i, p in joined.items()
        ],
        **tail,
        "background": [
            *({"effect": e, "joint": at(i), "parameters": p}
              for e, joined in background.effects.items() for i, p in joined.items()),
            *cell.facts(), *logger.facts(),
            *({"effect": e, "joint": None, "parameters": {}} for e in laws),
        ],
        "cell": asdict(cell), "sensors": logger.told(),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1) + "\n")


def acted_windows(acted: np.ndarray, size: float, period: float) -> dict[str, list[list[float]]]:
    """Time intervals of each recording in which an outside force (samples, recordings) acted."""
    return {f: stretches(acted[:, i], size, period) for i, f in enumerate(files())}
