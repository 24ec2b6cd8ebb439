"""Localization of an error: which joint causes it, in which regime, in which time intervals.

A position error spreads along the kinematic chain; the missing generalized force does not. Position
residuals are therefore converted to forces by the linearized equation of motion, and compared with
the forces that encoder noise alone would give.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from pytest_twin.arrays import FloatArray
from pytest_twin.diagnosis import temperature
from pytest_twin.diagnosis.locate_settings import LOCATE
from pytest_twin.diagnosis.prepare import PreparedProblem
from pytest_twin.diagnosis.problem import Problem
from pytest_twin.diagnosis.smoothing import SMOOTHING_WIDTH, derivatives
from pytest_twin.diagnosis.windows import runs
from pytest_twin.effects.contact_geoms import is_near_surface, with_distant_contacts
from pytest_twin.effects.segment import Segment
from pytest_twin.trial import Trial


@dataclass(frozen=True, slots=True)
class TimeAndRegime:
    """When and in which regime an error occurs.

    Attributes:
        summary: regime in words with units.
        windows: file name -> time intervals (start, end), s from the recording's first state.
    """

    summary: str
    windows: Mapping[str, list[list[float]]]


@dataclass(frozen=True, slots=True)
class Motion:
    """Smoothed measured motion of one segment.

    Attributes:
        name: the recording's file name.
        time: (n,) s.
        position, velocity, acceleration: (n, joints) measured motion, smoothed.
        load: (n, joints) N*m or N, inverse dynamics of the rigid bodies.
        command_rate: (n, joints) rate of the command, per s.
        touching: (n,) whether the robot is at a surface; None without surfaces.
        conditions: metadata of the recording: payload, controller, temperature, IDs.
    """

    name: str
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    load: FloatArray
    command_rate: FloatArray
    touching: NDArray[np.bool_] | None = None
    conditions: Mapping[str, str] = field(default_factory=dict)


def smooth_motions(prepared: PreparedProblem, trials: Sequence[Trial]) -> list[Motion]:
    """Smoothed motion of every segment, in the problem's order."""
    problem = prepared.problem
    return [
        _smooth_motion(problem, segment, trials[owner])
        for segment, owner in zip(problem.simulator.segments, prepared.segment_trial, strict=True)
    ]


def _smooth_motion(problem: Problem, segment: Segment, trial: Trial) -> Motion:
    q, v, a = derivatives(segment.time, segment.position)
    simulator, model = problem.simulator, segment.model
    contact = simulator.models.contact
    if contact.world.size:
        model = with_distant_contacts(model, contact.world, LOCATE.touching)
    data = mujoco.MjData(model)
    load = np.empty_like(q)
    # Fewer than 1200 samples: the load varies no faster than the motion.
    at = np.arange(0, len(q), max(1, len(q) // 600))
    rows = np.empty((len(at), q.shape[1]))
    close = np.zeros(len(at))
    result = np.zeros(model.nv)
    for i, k in enumerate(at):
        if segment.base is not None:
            segment.base.place(data, float(segment.time[k]))
        data.qpos[simulator.layout.qpos_index] = q[k]
        data.qvel[simulator.layout.dof_index] = v[k]
        data.qacc[simulator.layout.dof_index] = a[k]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_rne(model, data, 1, result)
        rows[i] = result[simulator.layout.dof_index]
        close[i] = is_near_surface(data, contact, LOCATE.touching) if contact.world.size else 0.0
    for j in range(q.shape[1]):
        load[:, j] = np.interp(segment.time, segment.time[at], rows[:, j])
    command = np.nan_to_num(segment.setpoint.at(segment.time))
    _, rate, _ = derivatives(segment.time, command)
    touches = np.interp(segment.time, segment.time[at], close) > 0.5
    return Motion(
        trial.path.name, trial.offset + segment.time, q, v, a, load, rate,
        touches if contact.world.size else None, trial.conditions,
    )  # fmt: skip


def error_windows(time: FloatArray, squared_error: FloatArray) -> list[list[float]]:
    """The fewest time intervals of a recording that contain 80 % of ``squared_error``."""
    total = float(squared_error.sum())
    if total <= 0.0 or len(time) < 3:
        return []
    interval = float(np.median(np.diff(time)))
    smooth = uniform_filter1d(squared_error, max(int(LOCATE.window / max(interval, 1e-6)), 1))
    order = np.argsort(-smooth, kind="stable")
    reached = np.searchsorted(np.cumsum(smooth[order]), LOCATE.cover * smooth.sum()) + 1
    chosen = np.zeros(len(time), dtype=bool)
    chosen[order[:reached]] = True
    found: list[list[float]] = []
    for run in runs(chosen):
        start, stop = float(time[run][0]), float(time[run][-1])
        if found and start - found[-1][1] <= LOCATE.merge:
            found[-1][1] = stop
        else:
            found.append([start, stop])
    weight = [float(squared_error[(time >= a) & (time <= b)].sum()) for a, b in found]
    best = sorted(range(len(found)), key=lambda i: -weight[i])[: LOCATE.most_windows]
    return [[round(found[i][0], 3), round(found[i][1], 3)] for i in sorted(best)]


def locate_error(
    motions: Sequence[Motion], squared_error: FloatArray, joint: int, unit: str
) -> TimeAndRegime:
    """When and in which regime of a joint a squared error occurs.

    Args:
        squared_error: (samples over all segments,) squared error, not negative.
        joint, unit: column of the joint and its unit, rad or m.
    """
    recordings: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    at = 0
    for m in motions:
        recordings.setdefault(m.name, []).append((m.time, squared_error[at : at + len(m.time)]))
        at += len(m.time)
    total = max(float(squared_error.sum()), 1e-300)
    kept = {}
    for name, parts in recordings.items():
        # Windows of one recording are evaluated together.
        time, mine = (np.concatenate(x) for x in zip(*parts, strict=True))
        order = np.argsort(time, kind="stable")
        found = error_windows(time[order], mine[order])
        if found and float(mine.sum()) / total > 0.25 / len(recordings):
            kept[name] = found
    return TimeAndRegime(describe_regime(motions, squared_error, joint, unit), kept)


def describe_regime(
    motions: Sequence[Motion], squared_error: FloatArray, joint: int, unit: str
) -> str:
    """The regime that contains more of the error than of the time, in words with units."""
    total = float(squared_error.sum())
    if total <= 0.0:
        return "no particular regime"
    best, words = 0.0, "throughout the motion"
    slices = [(1.0, text, inside) for text, inside in list_regimes(motions, joint, unit)]
    position = np.concatenate([m.position[:, joint] for m in motions])
    low, high = _interval_with_error(position, squared_error)
    inside = (position >= low) & (position <= high)
    slices.append((LOCATE.searched, f"position {low:.2g} to {high:.2g} {unit}", inside))
    for weight, text, inside in slices:
        time = float(inside.mean())
        if not 0.02 < time < 0.8:
            continue
        held = float(squared_error[inside].sum()) / total
        score = weight * held * np.log(max(held / time, 1e-9))
        if held >= LOCATE.share and held / time >= LOCATE.lift and score > best:
            best = score
            words = f"{text} ({100 * held:.0f} % of the error in {100 * time:.0f} % of the time)"
    return words


def _interval_with_error(values: FloatArray, squared_error: FloatArray) -> tuple[float, float]:
    """The interval of values with the largest share of the error for its share of the time."""
    edges = np.quantile(values, np.linspace(0.0, 1.0, LOCATE.edges))
    order = np.argsort(values, kind="stable")
    summed = np.concatenate([[0.0], np.cumsum(squared_error[order])]) / max(
        float(squared_error.sum()), 1e-300
    )
    at = np.searchsorted(values[order], edges)
    held = summed[at][None, :] - summed[at][:, None]
    time = np.maximum((at[None, :] - at[:, None]) / len(values), 1e-9)
    score = np.where(held > LOCATE.share, held * np.log(np.maximum(held, 1e-9) / time), -np.inf)
    first, last = np.unravel_index(int(np.argmax(score)), score.shape)
    return float(edges[min(first, last)]), float(edges[max(first, last)])


def list_regimes(
    motions: Sequence[Motion], joint: int, unit: str
) -> list[tuple[str, NDArray[np.bool_]]]:
    """(words, mask over all samples) of each regime of the motion.

    Regimes are ranges of speed, direction, acceleration, position, load and time, reversals,
    contact, and metadata values that differ between recordings.
    """

    def column(name: str) -> FloatArray:
        return np.concatenate([getattr(m, name)[:, joint] for m in motions])

    q, v, a, load = (column(n) for n in ("position", "velocity", "acceleration", "load"))
    rate = column("command_rate")
    reversal = np.concatenate([_near_reversal(m, joint) for m in motions])
    since = np.concatenate([m.time for m in motions])
    end = np.concatenate([np.full(len(m.time), m.time[-1]) for m in motions])
    speed, push = np.abs(v), np.abs(a)
    slow, fast = (float(x) for x in np.quantile(speed, (0.3, 0.75)))
    hard = float(np.quantile(push, 0.75))
    # Of a joint that is mostly at rest, take the quantiles while it moves.
    slow = max(slow, LOCATE.still * float(speed.max()))
    if fast <= slow < speed.max():
        fast = float(np.median(speed[speed > slow]))
    if hard <= (least := LOCATE.still * float(push.max())) < push.max():
        hard = float(np.median(push[push > least]))
    heavy, light = (float(x) for x in np.quantile(np.abs(load), (0.75, 0.3)))
    low, high = (float(x) for x in np.quantile(q, (0.25, 0.75)))
    force = "N" if unit == "m" else "N*m"
    found = [
        (f"reversals, |velocity| < {slow:.2g} {unit}/s", reversal),
        (f"slow, |velocity| < {slow:.2g} {unit}/s", speed < slow),
        (f"fast, |velocity| > {fast:.2g} {unit}/s", speed > fast),
        ("moving in the positive direction", v > slow),
        ("moving in the negative direction", v < -slow),
        (f"accelerating, |acceleration| > {hard:.2g} {unit}/s^2", push > hard),
        (f"position above {high:.2g} {unit}", q > high),
        (f"position below {low:.2g} {unit}", q < low),
        (f"position within {low:.2g} and {high:.2g} {unit}", (q >= low) & (q <= high)),
        (f"loaded, |effort| > {heavy:.2g} {force}", np.abs(load) > heavy),
        (f"unloaded, |effort| < {light:.2g} {force}", np.abs(load) < light),
        ("at rest with a constant command", (speed < slow) & (np.abs(rate) < slow)),
        ("the first third of the recording", since < end / 3),
        ("the last third of the recording", since > 2 * end / 3),
    ]
    if all(m.touching is not None for m in motions):
        at_surface = np.concatenate([m.touching for m in motions if m.touching is not None])
        words = f"in contact or within {1e3 * LOCATE.touching:.0f} mm of a surface"
        found += [(words, at_surface), ("without contact", ~at_surface)]
    return found + _metadata_regimes(motions)


def _metadata_regimes(motions: Sequence[Motion]) -> list[tuple[str, NDArray[np.bool_]]]:
    """Regimes by metadata values, where few values differ between the recordings."""
    recordings = {m.name: m.conditions for m in motions}
    found = []
    for key in sorted({k for c in recordings.values() for k in c}):
        recorded = [c.get(key) for c in recordings.values()]
        values = {v for v in recorded if v is not None}
        if len(set(recorded)) < 2:
            continue
        for words, among in _groups(key, values):
            mask = np.concatenate(
                [np.full(len(m.time), m.conditions.get(key) in among) for m in motions]
            )
            found.append((f"{key} {words}", mask))
    return found


def _groups(key: str, values: Collection[str]) -> list[tuple[str, Collection[str]]]:
    """(words, values) of each regime of a metadata key: each value, or two temperature halves."""
    words = _shorten(values)
    if len(values) <= LOCATE.most_values:
        return [(words[v], (v,)) for v in sorted(values)]
    measured = (
        temperature.parse_temperatures(values) if key == temperature.TEMPERATURE_KEY else None
    )
    if measured is None:
        return []
    order = sorted(values, key=lambda v: measured[v])
    cold, warm = order[: len(order) // 2], order[len(order) // 2 :]
    return [(f"up to {words[cold[-1]]}", cold), (f"from {words[warm[0]]}", warm)]


def _shorten(values: Collection[str]) -> dict[str, str]:
    """Metadata value -> its text, numbers rounded to four digits where they stay different."""
    short = {v: _four_digits(v) for v in values}
    return short if len({*short.values()}) == len(short) else {v: v for v in values}


def _four_digits(value: str) -> str:
    try:
        number = float(value)
    except ValueError:
        return value
    return min(value, f"{number:.4g}", key=len)


def _near_reversal(m: Motion, joint: int) -> NDArray[np.bool_]:
    """(n,) within 0.15 s of a change of direction."""
    v = m.velocity[:, joint]
    # Stops between two movements do not count as changes of direction.
    moving = np.flatnonzero(np.abs(v) > LOCATE.still * np.abs(v).max())
    turned = np.flatnonzero(np.diff(np.signbit(v[moving])))
    turn = m.time[moving[np.union1d(turned, turned + 1)]]
    if not turn.size:
        return np.zeros(len(v), dtype=bool)
    nearest = np.abs(m.time[:, None] - turn[None, :]).min(axis=1)
    near: NDArray[np.bool_] = nearest < 0.15
    return near


@dataclass(frozen=True, slots=True)
class MissingForce:
    """Generalized force that the model lacks, by joint.

    Attributes:
        force: (samples, joints) over all segments, N*m or N.
        noise: (joints,) RMS force that encoder noise alone would give.
    """

    force: FloatArray
    noise: FloatArray

    @property
    def strength(self) -> FloatArray:
        """(joints,) signal-to-noise ratio of the missing force."""
        size = np.sqrt(np.nanmean(self.force**2, axis=0))
        strength: FloatArray = np.sqrt(np.maximum((size / self.noise) ** 2 - 1.0, 0.0))
        return strength


def compute_missing_force(
    problem: Problem, residual: FloatArray, noise: FloatArray
) -> MissingForce:
    """The generalized force that would remove position residuals.

    Small deviations r of the simulated motion obey M(q) r'' + D r' + K r = f. D and K are damping
    and stiffness of the drives and of passive elements. f is the missing force of each joint.

    Args:
        residual: (samples, signals) over all segments, positions first.
        noise: (joints,) RMS encoder noise, rad or m.
    """
    simulator = problem.simulator
    joints = len(simulator.joints)
    forces, noises = [], []
    at = 0
    for segment in simulator.segments:
        n = len(segment.time)
        r = residual[at : at + n, :joints]
        at += n
        usual = float(np.median(np.diff(segment.time)))
        r0, r1, r2 = derivatives(segment.time, np.nan_to_num(r))
        model = segment.model
        data = mujoco.MjData(model)
        mass = np.zeros((model.nv, model.nv))
        damping, stiffness = _damping_and_stiffness(problem, model)
        dof = simulator.layout.dof_index
        force = np.empty_like(r0)
        step = max(1, n // 60)
        inertia = np.zeros((joints, joints))
        for k in range(0, n, step):
            if segment.base is not None:
                segment.base.place(data, float(segment.time[k]))
            data.qpos[simulator.layout.qpos_index] = segment.position[k]
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, mass)
            inertia = mass[np.ix_(dof, dof)]
            block = slice(k, min(k + step, n))
            force[block] = r2[block] @ inertia.T + r1[block] * damping + r0[block] * stiffness
        forces.append(force)
        half = max(round(0.5 * SMOOTHING_WIDTH / usual), 3)
        basis = np.vander(np.arange(-half, half + 1) / half, 4, increasing=True)
        w = np.linalg.pinv(basis)
        gain = [np.linalg.norm(w[o]) * f / (half * usual) ** o for o, f in ((0, 1), (1, 1), (2, 2))]
        noises.append(
            (inertia**2 @ noise**2) * gain[2] ** 2
            + (damping * noise * gain[1]) ** 2
            + (stiffness * noise * gain[0]) ** 2
        )
    return MissingForce(np.concatenate(forces), np.sqrt(np.maximum(np.mean(noises, axis=0), 1e-30)))


def _damping_and_stiffness(
    problem: Problem, model: mujoco.MjModel
) -> tuple[FloatArray, FloatArray]:
    """(joints,) damping and stiffness of drives and passive elements."""
    simulator = problem.simulator
    damping = model.dof_damping[simulator.layout.dof_index].copy()
    stiffness = model.jnt_stiffness[simulator.layout.joint_ids].copy()
    for j, actuator in enumerate(simulator.layout.actuator):
        if actuator >= 0 and model.actuator_biastype[actuator]:
            gear = simulator.layout.gear[j]
            stiffness[j] -= model.actuator_biasprm[actuator, 1] * gear**2
            damping[j] -= model.actuator_biasprm[actuator, 2] * gear**2
    return damping, stiffness
