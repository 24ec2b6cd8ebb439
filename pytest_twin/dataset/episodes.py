"""Compare episodes with each other: other following, copies, slow drift; noise of encoders."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.dataset.finding import Finding, Unknown
from pytest_twin.dataset.following import Following, Motion, aligned
from pytest_twin.formats.recordings.lerobot_units import is_gripper
from pytest_twin.words import list_names

_APART, _TIMES = math.radians(8.0), 4.0
"""rad, and multiples of the usual episode's, of the distance between states and where the actions
and all other episodes put them. Contact and sag stay below."""
_MOVES = math.radians(20.0)
"""rad. A joint that moves less shows neither its resolution nor its noise."""
_NOISE, _NOISIER = math.radians(0.5), 4.0
"""rad, and multiples of the action's, of a state's noise. Encoders of small arms have 0.1 deg."""
_COARSE = math.radians(1.0)
"""rad. Coarser encoders than any servo's; the coarsest common one has 0.3 deg."""
_DRIFT = math.radians(3.0)
"""rad that an offset drifts over all episodes."""
_STRAIGHT = 0.9
"""Correlation of offset and episode above which the offset drifts."""
_HOME, _ELSEWHERE = math.radians(3.0), math.radians(15.0)
"""rad within which episodes start at one place, and from which another place is a new one."""
_FEWEST = 3
"""Episodes without which there is no usual one."""
_SHORTEST = 10
"""Frames that a copied episode has at least."""


def compare_episodes(
    motions: Mapping[str, Motion],
    joints: Mapping[str, Following],
    numbers: Sequence[int],
    period: float,
    in_unit: Mapping[str, tuple[float, str]],
    reported: Collection[tuple[str | None, int]],
) -> tuple[list[Finding], list[Unknown]]:
    """Return faults of single episodes and of single joints' encoders.

    Args:
        numbers: number of each episode.
        period: time between frames, s.
        in_unit: joint -> units per rad, and the name of the unit.
        reported: joints and numbers of episodes that have another finding.
    """
    findings: list[Finding] = []
    for name, motion in motions.items():
        if is_gripper(name):
            continue
        scale, unit = in_unit[name]
        if len(numbers) >= _FEWEST:
            unlike = _unlike(name, motion, joints[name], numbers, period, scale, unit)
            findings += [one for one in unlike if {(name, n) for n in one.episodes} - set(reported)]
        findings += _slow_drift(name, joints[name], numbers, scale, unit)
        findings += _encoder(name, motion, scale, unit)
    findings += _copies(motions, numbers)
    return findings, _starts(motions, numbers)


def _unlike(
    name: str,
    motion: Motion,
    usual: Following,
    numbers: Sequence[int],
    period: float,
    scale: float,
    unit: str,
) -> Iterator[Finding]:
    """Yield episodes whose states are not where their actions put the other episodes' states."""
    if usual.correlation is None or (usual.gain is not None and usual.gain < 0.0):
        return
    frames = 0.0 if usual.lag is None else usual.lag / period
    centre = float(np.median(usual.by_episode))
    distances = []
    for state, action in zip(motion.state, motion.action, strict=True):
        states, actions = aligned(Motion([state], [action]), frames)
        distances.append(float(np.sqrt(np.mean((states - actions - centre) ** 2))))
    limit = max(_APART, _TIMES * float(np.median(distances)))
    others = [at for at, value in enumerate(distances) if value > limit]
    if not others or 2 * len(others) > len(distances):
        return
    worst = max(others, key=lambda at: distances[at])
    yield Finding(
        "unlike_others",
        f"its states are up to {distances[worst] * scale:.0f} {unit} (RMS) from where the other "
        "episodes have them for such actions",
        "another zero, sign, order of joints, lag or unit in these episodes; a collision",
        name,
        tuple(numbers[at] for at in others),
    )


def _slow_drift(
    name: str, one: Following, numbers: Sequence[int], scale: float, unit: str
) -> Iterator[Finding]:
    """Yield a joint whose offset grows from episode to episode."""
    values = one.by_episode
    if len(values) < 2 * _FEWEST or not one.follows:
        return
    at = np.asarray(numbers, dtype=np.float64)
    slope, height = np.polyfit(at, values, 1)
    total = float(slope * np.ptp(at))
    if abs(total) <= _DRIFT or abs(float(np.corrcoef(at, values)[0, 1])) < _STRAIGHT:
        return
    # A single step also correlates with the number; it is the finding of ``drift``.
    rest = values - slope * at - height
    if float(np.abs(np.diff(rest)).max()) > 0.5 * abs(total):
        return
    yield Finding(
        "drift",
        f"its offset from the leader changes steadily, by {total * scale:+.1f} {unit} over "
        f"{len(values)} episodes",
        "a slipping horn or belt; a servo that warms up",
        name,
    )


def _encoder(name: str, motion: Motion, scale: float, unit: str) -> Iterator[Finding]:
    """Yield a joint whose state is noisier than its action, or coarser than an encoder."""
    states = np.concatenate(motion.state)
    if not len(states) or float(np.ptp(states)) < _MOVES:
        return
    noise, asked = (_noise(series) for series in (motion.state, motion.action))
    if noise > max(_NOISE, _NOISIER * asked):
        yield Finding(
            "noise",
            f"its state has a noise of {noise * scale:.2g} {unit} from frame to frame",
            "cable, supply and magnet of the encoder; read errors of the bus",
            name,
        )
    steps = np.diff(np.unique(np.round(states, 5)))
    if len(steps) and float(steps.min()) > _COARSE:
        yield Finding(
            "resolution",
            f"its state has steps of {float(steps.min()) * scale:.2g} {unit}",
            "record unrounded positions",
            name,
        )


def _noise(series: Sequence[FloatArray]) -> float:
    """Return the standard deviation of white noise on smooth series, rad.

    The second difference of white noise has a variance of 6 times its own.
    """
    bends = np.concatenate([np.diff(one, 2) for one in series])
    return float(np.median(np.abs(bends)) / (0.6745 * math.sqrt(6.0))) if len(bends) else 0.0


def _copies(motions: Mapping[str, Motion], numbers: Sequence[int]) -> Iterator[Finding]:
    """Yield episodes that repeat the states of an earlier one, to the last digit."""
    if not motions:
        return
    episodes = [
        np.column_stack([motion.state[at] for motion in motions.values()])
        for at in range(len(numbers))
    ]
    copied: dict[int, int] = {}
    first: dict[bytes, int] = {}
    for at, states in enumerate(episodes):
        if len(states) < _SHORTEST or not np.ptp(states, axis=0).any():
            continue
        earlier = first.setdefault(states[:_SHORTEST].tobytes(), at)
        if earlier != at and _starts_alike(states, episodes[earlier]):
            copied[numbers[at]] = numbers[earlier]
    if copied:
        yield Finding(
            "copied_episode",
            "the states are those of "
            + list_names([f"episode {earlier}" for earlier in dict.fromkeys(copied.values())]),
            "remove the copies: a held-out copy confirms any policy",
            None,
            tuple(copied),
        )


def _starts_alike(first: FloatArray, second: FloatArray) -> bool:
    both = min(len(first), len(second))
    return bool(np.array_equal(first[:both], second[:both]) and np.ptp(first[:both], axis=0).any())


def _starts(motions: Mapping[str, Motion], numbers: Sequence[int]) -> list[Unknown]:
    """Return the question why later episodes start at another place, if each part has one place."""
    moved: dict[int, list[str]] = {}
    for name, motion in motions.items():
        starts = np.array([state[0] for state in motion.state])
        for cut in range(_FEWEST, len(starts) - _FEWEST + 1):
            before, after = starts[:cut], starts[cut:]
            if (
                np.ptp(before) < _HOME
                and np.ptp(after) < _HOME
                and abs(np.median(after) - np.median(before)) > _ELSEWHERE
            ):
                moved.setdefault(numbers[cut], []).append(name)
    return [
        Unknown(
            f"why {list_names(names)} start elsewhere from episode {number}",
            "another home pose looks the same as another zero, sign or order of joints in both "
            "arms",
            "compare an image or a measured pose of both parts",
        )
        for number, names in moved.items()
    ]


def degrees_in_radians(motions: Mapping[str, Motion], unit: str) -> Iterator[Finding]:
    """Yield the finding that all positions fit into two turns of a unit smaller than rad.

    Args:
        unit: unit in which the positions were read.
    """
    arm = [motion for name, motion in motions.items() if not is_gripper(name)]
    if unit != "deg" or len(arm) < _FEWEST:
        return
    largest = max(float(np.abs(one).max()) for motion in arm for one in motion.state if len(one))
    if math.degrees(largest) <= 2 * math.pi:
        yield Finding(
            "units",
            f"no joint leaves +-{math.degrees(largest):.2g} deg; positions in rad?",
            "compare with --units rad",
        )
