"""Check the clock of a data set, and look for frames that its recorder lost."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pytest_twin.arrays import FloatArray
from pytest_twin.dataset.finding import Finding, Unknown
from pytest_twin.words import counted

_COMPUTED = 1e-4
"""s. LeRobot's own tolerance for stamps, which it computes from frame / fps."""
_DRIFT_FRAMES = 0.5
"""Frames by which the clock may be off at the end of an episode."""
_MISSING = 1.5
"""Periods. A longer interval lacks a frame."""
_FAST = math.radians(1.0)
"""rad per frame, over all joints. Slower motion shows no lost frame."""
_ALONG, _BETWEEN, _TWICE = 0.985, 1.3, 1.7
"""Cosine of the angle to the motion before and after, and ratio of sizes, of a step over a lost
frame. A joint cannot double its speed for one frame and then have its old speed. Steps between the
two ratios are no lost frames."""
_STEADY = 0.35
"""Largest difference between the motion before and after such a step, relative to their sum."""
_FEWEST = 3
"""Events below which they may be chance."""
_REPEATED = 0.01
"""Fraction of the frames in motion that may repeat the one before."""


def check_clock(
    table: Mapping[str, FloatArray], info: Mapping[str, Any]
) -> tuple[list[Finding], list[Unknown]]:
    """Return faults of stamps, numbers of frames, and totals.

    Args:
        table: columns ``timestamp`` (s), ``frame_index`` and ``episode_index``.
        info: content of ``info.json``.
    """
    fps = info.get("fps")
    episode = table["episode_index"]
    bounds = np.append(np.flatnonzero(np.diff(episode, prepend=episode[0] - 1)), len(episode))
    findings = _totals(bounds, info)
    unnumbered, missing, disordered, rates = [], [], [], []
    computed = True
    for begin, end in itertools.pairwise(bounds.tolist()):
        number = int(episode[begin])
        lost = np.diff(table["frame_index"][begin:end]) - 1
        if (lost != 0).any():
            unnumbered.append((number, int(lost[lost > 0].sum())))
        if not isinstance(fps, (int, float)) or not 0 < fps < 1e6:
            continue
        stamp = table["timestamp"][begin:end]
        steps = np.diff(stamp)
        frame = np.arange(end - begin) if not len(lost) else table["frame_index"][begin:end]
        exact = (frame - frame[0]) / fps
        tolerance = _COMPUTED + 2.0**-22 * np.abs(stamp)
        if (np.abs(stamp - stamp[0] - exact) <= tolerance).all():
            continue
        computed = False
        if (steps <= 0.0).any():
            disordered.append(number)
            continue
        gaps = np.flatnonzero(steps > _MISSING / fps)
        if len(gaps):
            missing.append((number, int(np.rint(steps[gaps] * fps - 1.0).sum())))
        usual = steps[steps <= _MISSING / fps]
        if len(usual):
            rates.append((float(usual.mean()) * fps, end - begin))
    findings += [
        Finding(code, f"{counted(sum(n for _, n in lost), 'frame')} lost by {source}, in "
                f"{counted(len(lost), 'episode')}",
                "load of the computer while recording: cameras, encoding, disk",
                episodes=tuple(number for number, _ in lost))
        for code, source, lost in (
            ("frame_numbers", "the numbers of the frames", unnumbered),
            ("dropped_frames", "the stamps", missing),
        ) if lost
    ]  # fmt: skip
    if disordered:
        findings.append(Finding(
            "clock", "stamps repeat or go back", "the clock of the recorder",
            episodes=tuple(disordered),
        ))  # fmt: skip
    findings += _rate(rates, fps)
    if not computed:
        return findings, []
    if isinstance(fps, (int, float)):
        why = "the stamps are frame / fps: LeRobot computes them and records no time"
    else:
        why = "info.json states no fps"
    return findings, [Unknown(
        "clock and jitter", why, "the log of the recorder, or a clock in view of the camera",
    )]  # fmt: skip


def _totals(bounds: FloatArray, info: Mapping[str, Any]) -> list[Finding]:
    findings = []
    for key, noun, count in (
        ("total_episodes", "episodes", len(bounds) - 1), ("total_frames", "frames", int(bounds[-1]))
    ):  # fmt: skip
        stated = info.get(key)
        if type(stated) is int and stated != count:
            findings.append(Finding(
                "totals", f"info.json states {stated} {noun}, the files have {count}",
                "download or convert the whole data set again",
            ))  # fmt: skip
    return findings


def _rate(rates: Sequence[tuple[float, int]], fps: Any) -> list[Finding]:
    """A clock whose rate differs from fps: ``rates`` has periods per frame, and frames."""
    if not rates:
        return []
    rate = float(np.median([rate for rate, _ in rates]))
    longest = max(frames for _, frames in rates)
    if abs(rate - 1.0) * longest <= _DRIFT_FRAMES:
        return []
    return [Finding(
        "clock",
        f"the stamps advance {rate:.4f} periods a frame: {fps / rate:.4g} Hz, where info.json "
        f"states {fps:g}; {abs(rate - 1.0) * longest / fps:.3g} s in the longest episode",
        "the rate at which the recorder ran; states and videos are read at fps",
    )]  # fmt: skip


def hidden_losses(
    times: Sequence[FloatArray], states: Sequence[FloatArray], numbers: Sequence[int]
) -> list[Finding]:
    """Return frames that are missing or repeated although stamps are regular.

    Args:
        times: (n,) stamps of each episode.
        states: (n, joints) positions of each episode, rad, without grippers.
        numbers: number of each episode.
    """
    skipped, repeated = [], []
    in_motion = between = 0
    for time, state, number in zip(times, states, numbers, strict=True):
        steps = np.diff(state, axis=0)
        size = np.linalg.norm(steps, axis=1)
        if len(steps) < 3:
            continue
        before, step, after = steps[:-2], steps[1:-1], steps[2:]
        usual = 0.5 * (before + after)
        length = np.linalg.norm(usual, axis=1)
        moving = length > _FAST
        in_motion += int(moving.sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = (step * usual).sum(axis=1) / length**2
            cosine = (step * usual).sum(axis=1) / (length * size[1:-1])
            steady = np.linalg.norm(after - before, axis=1) / (2.0 * length) < _STEADY
        intervals = np.diff(time)
        regular = intervals[1:-1] < _MISSING * float(np.median(intervals))
        along = moving & regular & steady & (cosine > _ALONG)
        skipped += [number] * int((along & (ratio > _TWICE)).sum())
        between += int((along & (ratio > _BETWEEN) & (ratio <= _TWICE)).sum())
        repeated += [number] * int((moving & (size[1:-1] == 0.0)).sum())
    findings = []
    # A lost frame doubles a step, and nothing makes it half as much longer. Jerky motion has more
    # steps that are a little longer than steps of twice the length.
    if len(skipped) >= _FEWEST and len(skipped) > between:
        findings.append(Finding(
            "dropped_frames",
            f"{len(skipped)} steps of the whole arm are about twice as long as those before and "
            "after: frames are missing although the stamps are regular",
            "load of the computer while recording: cameras, encoding, disk",
            episodes=tuple(dict.fromkeys(skipped)),
        ))  # fmt: skip
    if len(repeated) >= _FEWEST and len(repeated) > _REPEATED * in_motion:
        findings.append(Finding(
            "repeated_frames",
            f"{len(repeated)} of {in_motion} states in motion repeat the one before",
            "the rate of the servo bus; retries after read errors",
            episodes=tuple(dict.fromkeys(repeated)),
        ))  # fmt: skip
    return findings
