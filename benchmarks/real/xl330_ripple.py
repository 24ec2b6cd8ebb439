"""XL330: test whether the speed ripple of slow motions depends on the joint angle.

    python benchmarks/real/xl330_ripple.py

Takes the slow rises of the pendulum (`up_and_down`, and `sin_time_square` before its first
reversal) at four firmware gains. The ripple is the squared velocity over position minus its mean
over 60 mrad; it shows position-dependent forces in the kinetic energy. The script prints the
correlation of the ripple between motions at the same angles, and the correlation after random
shifts of each motion, which removes any dependence on the angle. It then prints the best common
wavenumber and its share of the ripple, with and without random shifts.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from recorded import folder_of

from pytest_twin.arrays import FloatArray
from pytest_twin.formats.mcap import read_recording

GAINS = (100, 200, 400, 800)
# Log -> time interval of its slow rise, s.
RISES = {"up_and_down": (0.3, 3.0), "sin_time_square": (0.2, 1.25)}
STEP, MEAN_OVER, LEAST = 0.002, 0.06, 0.2
"""Distance of positions, range of the mean, and smallest common range of two rises, rad."""
FARTHEST = 40
"""Largest shift of a rise, in positions."""
WAVENUMBERS, DRAWS = np.arange(20.0, 420.0), 200
POSITIONS = np.arange(-0.1, 1.3, STEP)


def ripple(log: str, gain: int) -> FloatArray:
    """(positions,) ripple of a rise, (rad/s)^2, NaN outside of its range."""
    recording = read_recording(folder_of("xl330") / "recordings" / f"kp{gain}_{log}.mcap")
    state = recording.series["state"]
    assert state.position is not None
    assert state.velocity is not None
    time = 1e-9 * (state.stamp - state.stamp[0])
    first, last = RISES[log]
    rises = (time >= first) & (time <= last)
    place = np.round((state.position[rises, 0] - POSITIONS[0]) / STEP).astype(int)
    count = np.bincount(place, minlength=len(POSITIONS))
    speed = np.bincount(place, state.velocity[rises, 0], minlength=len(POSITIONS))
    (seen,) = np.nonzero(count)
    way = np.arange(seen[0], seen[-1] + 1)
    squared = np.interp(way, seen, speed[seen] / count[seen]) ** 2
    half = round(0.5 * MEAN_OVER / STEP)
    window = np.ones(2 * half + 1) / (2 * half + 1)
    out = np.full(len(POSITIONS), np.nan)
    out[way] = squared - np.convolve(np.pad(squared, half, mode="edge"), window, "valid")
    return out


def alike(one: FloatArray, other: FloatArray, offset: int) -> float:
    """Correlation of two ripples, one of them shifted by some positions; NaN if too few overlap."""
    moved = np.full_like(other, np.nan)
    here, there = (slice(max(o, 0), len(other) + min(o, 0)) for o in (offset, -offset))
    moved[here] = other[there]
    both = np.isfinite(one) & np.isfinite(moved)
    if both.sum() * STEP < LEAST:
        return float("nan")
    return float(np.corrcoef(one[both], moved[both])[0, 1])


def mean_alike(ripples: list[FloatArray], offsets: NDArray[np.int64]) -> float:
    """Mean correlation of all pairs, each shifted by some positions."""
    pairs = itertools.combinations(zip(ripples, offsets, strict=True), 2)
    each = [alike(one, other, int(theirs - mine)) for (one, mine), (other, theirs) in pairs]
    return float(np.nanmean(each))


def shared(ripples: list[FloatArray], offsets: FloatArray) -> FloatArray:
    """(wavenumbers,) share of all normalized ripples that a wave with a common phase explains.

    Each rise is shifted by its offset (rad).
    """
    angle, level = [], []
    for each, offset in zip(ripples, offsets, strict=True):
        seen = np.isfinite(each)
        angle.append(POSITIONS[seen] + offset)
        level.append(each[seen] / each[seen].std())
    q, y = np.concatenate(angle), np.concatenate(level)
    shares = []
    for k in WAVENUMBERS:
        waves = np.stack([np.cos(k * q), np.sin(k * q)], axis=1)
        left = y - waves @ np.linalg.lstsq(waves, y, rcond=None)[0]
        shares.append(1.0 - float(left @ left / (y @ y)))
    return np.array(shares)


def main() -> None:
    """Read, compare, print."""
    rises = {(log, gain): ripple(log, gain) for log in RISES for gain in GAINS}
    slow = list(rises.values())
    print("| `up_and_down` at gains | correlation at the same angle |")
    print("|---|---|")
    for one, other in itertools.combinations(GAINS, 2):
        both = rises["up_and_down", one], rises["up_and_down", other]
        print(f"| {one} and {other} | {alike(*both, 0):.2f} |")
    same = mean_alike(slow, np.zeros(len(slow), dtype=int))
    found = shared(slow, np.zeros(len(slow)))
    random = np.random.default_rng(1)
    moves = [random.integers(-FARTHEST, FARTHEST + 1, len(slow)) for _ in range(DRAWS)]
    moved = [mean_alike(slow, each) for each in moves]
    print(f"\nMean over all pairs of the {len(slow)} rises: {same:.2f} at the same angle; "
          f"{np.median(moved):.2f} in the median of {DRAWS} draws that move each rise by up to "
          f"{1e3 * FARTHEST * STEP:g} mrad, {max(moved):.2f} at most.")  # fmt: skip
    chance = [shared(slow, STEP * each).max() for each in moves]
    k = WAVENUMBERS[found.argmax()]
    print(f"One wave of {k:g} a turn takes {found.max():.1%} of the ripple of all; moved, the best "
          f"wave takes {np.median(chance):.1%} in the median of {DRAWS} draws, {max(chance):.1%} "
          "at most.")  # fmt: skip


if __name__ == "__main__":
    main()
