"""Compare the follower of a teleoperated arm with its leader: offset, lag and gain of each joint.

The action of a LeRobot data set is the position of the leader, or the goal that a policy sent; the
observed state is the position of the follower.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.dataset.finding import Finding, Unknown
from pytest_twin.formats.recordings.lerobot_units import is_gripper
from pytest_twin.words import list_names

_LONGEST_LAG = 0.6
"""s. Lags up to this are looked for."""
_EARLIEST = 2
"""Frames by which a state may precede its action."""
_MOVES = math.radians(5.0)
"""rad. A joint that moves less shows no lag and no gain."""
_FOLLOWS, _UNRELATED = 0.9, 0.6
"""Correlation with the action above which a joint follows it, and below which it does not."""
_SAG, _OFFSET = math.radians(3.0), math.radians(8.0)
"""rad. A servo of a small arm sags by up to the first under load: an STS3215 of an SO-101 holds
2.3 degrees below its goal. The second is no sag."""
_CONSTANT = 0.5
"""Fraction of an offset that has to remain at the 10 % of samples with the smallest offset."""
_GAIN = 0.15
_LATE = 0.35
"""s. Lags of position servos with LeRobot's gains are 0.05 to 0.2 s."""
_LATER, _LATER_FRAMES = 0.1, 3.0
"""s and frames by which a joint may lag behind the other joints."""
_STEP, _STEP_NOISE = math.radians(3.0), 4.0
"""rad, and multiples of the scatter, of a step of the offset between two episodes."""
_FEWEST = 3
"""Episodes on either side of a step."""
_EXACT = 1e-9
"""rad. States that are their actions scatter by less, from rounding alone."""
_TRIMMED = 2.5
"""Standard deviations beyond which a sample, such as one in contact, does not count."""


@dataclass(frozen=True, slots=True)
class Motion:
    """State and action of one joint, rad, frame by frame in each episode."""

    state: Sequence[FloatArray]
    action: Sequence[FloatArray]


@dataclass(frozen=True, slots=True)
class Following:
    """How a joint follows its action.

    Attributes:
        offset: median of state minus action, rad.
        is_constant: whether the offset has this sign and size at nearly all times.
        lag: s; None for a joint that hardly moves or does not follow.
        gain: motion of the state divided by that of the action; None as for ``lag``.
        correlation: of state and action at this lag; None for a joint that hardly moves.
        moved: range of the state, rad.
        by_episode: offset in each episode, rad.
    """

    offset: float
    is_constant: bool
    lag: float | None
    gain: float | None
    correlation: float | None
    moved: float
    by_episode: FloatArray

    @property
    def follows(self) -> bool:
        """Whether lag and gain are known."""
        return self.correlation is not None and abs(self.correlation) >= _FOLLOWS


def follow(motion: Motion, period: float) -> Following:
    """Determine offset, lag and gain of one joint.

    Args:
        period: time between frames, s.
    """
    asked = max(float(np.ptp(one)) for one in motion.action)
    moved = float(np.ptp(np.concatenate(motion.state)))
    lag = gain = correlation = None
    frames = 0.0
    if max(asked, moved) > _MOVES:
        frames, correlation = _best_lag(motion, period)
        state, action = aligned(motion, frames)
        if abs(correlation) >= _FOLLOWS:
            lag, gain = frames * period, _slope(action, state)
    pairs = [aligned(Motion([s], [a]), frames) for s, a in _pairs(motion)]
    by_episode = np.array([float(np.median(state - action)) for state, action in pairs])
    apart = np.concatenate([state - action for state, action in pairs])
    offset = float(np.median(apart))
    least = float(np.quantile(math.copysign(1.0, offset) * apart, 0.1))
    return Following(
        offset, least > _CONSTANT * abs(offset), lag, gain, correlation, moved, by_episode
    )


def _pairs(motion: Motion) -> Iterator[tuple[FloatArray, FloatArray]]:
    return zip(motion.state, motion.action, strict=True)


def aligned(motion: Motion, frames: float) -> tuple[FloatArray, FloatArray]:
    """Return all states, and the actions this many frames earlier, rad."""
    states, actions = [], []
    for state, action in _pairs(motion):
        at = np.arange(len(state)) - frames
        inside = (at >= 0) & (at <= len(action) - 1)
        if not inside.any():
            inside = np.ones(len(state), dtype=bool)
        states.append(state[inside])
        actions.append(np.interp(at[inside], np.arange(len(action)), action))
    return np.concatenate(states), np.concatenate(actions)


def _best_lag(motion: Motion, period: float) -> tuple[float, float]:
    """Lag in frames with the largest correlation (absolute), and the correlation."""
    shortest = min(len(state) for state in motion.state)
    longest = max(1, min(round(_LONGEST_LAG / period), shortest // 3))
    lags = np.arange(-min(_EARLIEST, shortest // 3), longest + 1)
    values = np.array([_correlation(*aligned(motion, float(lag))) for lag in lags])
    at = int(np.argmax(np.abs(values)))
    fine = 0.0
    if 0 < at < len(lags) - 1:
        left, top, right = np.abs(values[at - 1 : at + 2])
        bend = left - 2.0 * top + right
        fine = 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return float(lags[at] + fine), float(values[at])


def _correlation(first: FloatArray, second: FloatArray) -> float:
    first, second = first - first.mean(), second - second.mean()
    power = float(np.sqrt((first @ first) * (second @ second)))
    return float(first @ second) / power if power > 0.0 else 0.0


def _slope(action: FloatArray, state: FloatArray) -> float:
    """Slope of states over actions, without samples that are far off, such as in contact."""
    rows = np.ones(len(action), dtype=bool)
    slope = 1.0
    for _ in range(3):
        if np.ptp(action[rows]) <= 0.5 * _MOVES:
            break
        slope, height = np.polyfit(action[rows], state[rows], 1)
        apart = state - slope * action - height
        spread = float(np.std(apart[rows]))
        if spread <= _EXACT:
            break
        rows = np.abs(apart) <= _TRIMMED * spread
    return float(slope)


def judge(
    joints: Mapping[str, Following], period: float, in_unit: Mapping[str, tuple[float, str]]
) -> tuple[list[Finding], list[Unknown]]:
    """Return faults of leader and follower, and what the data do not show.

    Grippers are not judged: an object in the gripper keeps them from following.

    Args:
        period: time between frames, s.
        in_unit: joint -> units per rad, and the name of the unit.
    """
    findings: list[Finding] = []
    doubtful = []
    arm = {name: one for name, one in joints.items() if not is_gripper(name)}
    lags = [one.lag for one in arm.values() if one.lag is not None]
    usual_lag = float(np.median(lags)) if lags else 0.0
    for name, one in arm.items():
        scale, unit = in_unit[name]
        if not one.follows and one.correlation is not None:
            continue
        if one.gain is not None and one.gain < 0.0:
            findings.append(Finding(
                "direction", f"moves against its action (gain {one.gain:.2f})",
                "drive_mode of leader and follower in their calibrations", name,
            ))  # fmt: skip
            continue
        if one.gain is not None and abs(one.gain - 1.0) > _GAIN:
            findings.append(Finding(
                "gain", f"moves {one.gain:.2f} times as far as its action",
                "calibrated ranges of leader and follower; a torque limit", name,
            ))  # fmt: skip
        elif abs(one.offset) > _OFFSET and one.is_constant:
            findings.append(Finding(
                "offset",
                f"the follower is {one.offset * scale:+.1f} {unit} from the leader at all times",
                "calibrate both arms in the same pose; a horn may have slipped on its spline", name,
            ))  # fmt: skip
        elif abs(one.offset) > _SAG:
            doubtful.append(f"{name} ({one.offset * scale:+.1f} {unit})")
        findings += _judge_lag(name, one, usual_lag, period)
    unknown = [Unknown(
        f"offset of {list_names(doubtful)}",
        "sag of a servo under load looks the same as an offset of the zero",
        "move leader and follower by hand, without torque, to one pose and compare the readings",
    )] if doubtful else []  # fmt: skip
    return findings, unknown


def _judge_lag(name: str, one: Following, usual: float, period: float) -> list[Finding]:
    if one.lag is None:
        return []
    if one.lag < -0.5 * period:
        return [Finding(
            "lag", f"states are {-1e3 * one.lag:.0f} ms earlier than the actions that they follow",
            "the order in which the recorder reads the state and sends the action", name,
        )]  # fmt: skip
    if one.lag > _LATE or one.lag - usual > max(_LATER, _LATER_FRAMES * period):
        return [Finding(
            "lag",
            f"follows its action {1e3 * one.lag:.0f} ms late, the joints usually {1e3 * usual:.0f}",
            "servo gains, return delay and baud rate; latency of a policy", name,
        )]  # fmt: skip
    return []


def unrelated(
    motions: Mapping[str, Motion], joints: Mapping[str, Following], period: float
) -> tuple[list[Finding], list[Unknown]]:
    """Return joints that follow the action of another joint, or none."""
    asked = [
        name for name, one in joints.items() if one.correlation is not None and not is_gripper(name)
    ]
    if asked and not any(joints[name].follows for name in asked):
        followed = _followed(motions, asked, asked, period)
        if not followed:
            return [], [Unknown(
                "leader against follower", "no joint follows its action",
                "actions that are joint positions; deltas, velocities and end-effector poses are "
                "not compared",
            )]  # fmt: skip
    lost = [
        name for name in asked
        if abs(joints[name].correlation or 0.0) < _UNRELATED and joints[name].moved > _MOVES
    ]  # fmt: skip
    followed = _followed(motions, lost, asked, period)
    findings = [
        Finding("swapped", f"follows the action of {followed[name]}, not its own",
                "motor ids and the order of names in state and action", name)
        if name in followed else
        Finding("not_following", f"does not follow its action (correlation "
                f"{joints[name].correlation:.2f})", "coupling, horn and torque of this joint", name)
        for name in lost
    ]  # fmt: skip
    findings += [
        Finding("stuck", "never moves, although its action does", "encoder, cable and horn", name)
        for name, one in joints.items()
        if is_gripper(name) and one.moved == 0.0 and one.correlation is not None
    ]
    partly = [name for name in asked if name not in lost and not joints[name].follows]
    if not partly:
        return findings, []
    return findings, [Unknown(
        f"offset, lag and gain of {list_names(partly)}",
        f"these joints follow their actions in part only (correlation below {_FOLLOWS})",
        "a slow motion of each joint without contact",
    )]  # fmt: skip


def _followed(
    motions: Mapping[str, Motion], names: Sequence[str], others: Sequence[str], period: float
) -> dict[str, str]:
    """Joint -> another joint whose action it follows."""
    return {
        name: other
        for name in names
        for other in others
        if name != other
        and abs(_best_lag(Motion(motions[name].state, motions[other].action), period)[1])
        >= _FOLLOWS
    }


def drift(
    joints: Mapping[str, Following], numbers: Sequence[int],
    in_unit: Mapping[str, tuple[float, str]],
) -> list[Finding]:  # fmt: skip
    """Return joints whose offset between follower and leader changes between episodes.

    Args:
        numbers: number of each episode.
        in_unit: joint -> units per rad, and the name of the unit.
    """
    findings = []
    for name, one in joints.items():
        values = one.by_episode
        if (
            is_gripper(name)
            or len(values) < 2 * _FEWEST
            or not (one.follows or one.correlation is None)
        ):
            continue
        cuts = range(_FEWEST, len(values) - _FEWEST + 1)
        at = max(cuts, key=lambda cut: abs(np.median(values[cut:]) - np.median(values[:cut])))
        before, after = float(np.median(values[:at])), float(np.median(values[at:]))
        rest = np.concatenate([values[:at] - before, values[at:] - after])
        scatter = 1.4826 * float(np.median(np.abs(rest)))
        if abs(after - before) <= max(_STEP, _STEP_NOISE * scatter):
            continue
        scale, unit = in_unit[name]
        findings.append(Finding(
            "drift",
            f"the follower is {before * scale:+.1f} {unit} from the leader until episode "
            f"{numbers[at - 1]} and {after * scale:+.1f} {unit} from episode {numbers[at]}",
            "what happened between these episodes: a new calibration, a slipped horn, a restart",
            name, tuple(numbers[at:]),
        ))  # fmt: skip
    return findings
